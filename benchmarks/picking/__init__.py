"""Picks and places of simulated arms, and collisions while one is expected."""
