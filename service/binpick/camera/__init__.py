"""The cameras: one protocol, its backends, and two of them as one instrument."""
