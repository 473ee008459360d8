"""The bin, its height map, and the parts in it."""
