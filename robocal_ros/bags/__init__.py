"""MCAP bags in and out, the recorder, replay."""
