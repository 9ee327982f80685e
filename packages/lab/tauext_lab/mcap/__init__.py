"""Samples, estimates, forces and events of a loop as MCAP files for viewers."""
