"""The calibration tool: boards in, a rig file out."""
