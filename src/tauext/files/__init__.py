"""How files are found, read and put in place.

In go paths and what is to be written. Out come file contents, and files that are
complete or not there at all, with their provenance. It imports no package of tauext but is open to all of them.
"""
