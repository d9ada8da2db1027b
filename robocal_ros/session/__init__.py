"""Stateful, clock-free objects: samples and commands in, estimates and events out."""
