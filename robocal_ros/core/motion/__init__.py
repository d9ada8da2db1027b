"""Motions that measure a tool: planned from where the robot stands, checked as they are sent."""
