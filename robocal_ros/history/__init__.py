"""The calibration history of a robot: proposed, decided, rolled back, never lost."""
