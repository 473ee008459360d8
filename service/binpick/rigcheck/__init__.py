"""The board: what is printed on it, where its points are seen, how well, and which end is which."""
