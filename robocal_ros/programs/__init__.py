"""Programs that a robot's own controller runs: points corrected in the file, frames shifted."""
