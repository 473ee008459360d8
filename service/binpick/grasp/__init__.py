"""Grasp candidates, what they would hit, and their order."""
