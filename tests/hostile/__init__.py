"""Hostile input for every command and reader: what it is made of, how a case runs, and what counts as a failure."""
