"""Measures the product against ground truth; never imported by it."""
