"""What all rooms stand on: errors and codes, frames, samples, streams, files."""
