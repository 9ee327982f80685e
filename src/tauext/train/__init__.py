"""Stages that write bundles: training, calibration of limits, refit.

Input: a dataset and settings, or a bundle and new recordings. Output: a bundle and the facts of its provenance. It
imports the packages before it; it prints nothing.
"""
