"""Benchmarks: accuracy on real measurements, speed beside other libraries."""
