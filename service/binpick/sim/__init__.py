"""The simulated cell: a world of settled parts, its cameras, its PLC and its judge."""
