"""Files: calibration history, bags, tables and robot descriptions."""
