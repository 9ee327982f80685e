"""Recordings and datasets of recordings.

Input: raw files of any supported format and a description of the arm. Output: validated recordings, cut and split, and
dataset folders. It imports `files`, `robot` and the core.
"""
