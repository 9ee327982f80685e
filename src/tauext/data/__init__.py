"""Recordings and datasets of recordings.

In go raw files of any supported format and a description of the arm. Out come validated recordings, cut and split, and
dataset folders. It imports `files`, `robot` and the core.
"""
