"""One cycle at a time: the state machine, its worker, and what is published."""
