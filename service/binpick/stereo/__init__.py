"""Rectified pair to measured disparity to organised cloud."""
