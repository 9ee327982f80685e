"""Readers of raw files, one module a format.

Input: a file. Output: its columns as a table of named arrays. They import `files`.
"""
