"""Shapes fitted to measured points."""
