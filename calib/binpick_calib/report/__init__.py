"""The report: one page that shows what a calibration is worth: it stands alone, and prints."""
