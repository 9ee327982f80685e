"""How files are found, read and put in place.

In go paths, URLs of object stores, and what is to be written. Out come file contents, local copies, and files that are
complete or not there at all, with their provenance. It imports no package of tauext but is open to all of them.
"""
