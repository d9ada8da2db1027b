"""Taught joints in, corrected ones out: on-line joint correction before the controller."""
