"""Readers of raw files, one module a format.

In goes a file. Out come its columns as a table of named arrays. They import `files`.
"""
