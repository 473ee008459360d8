"""Publishers show one snapshot and compute nothing; they reach the cell only through `ports`."""
