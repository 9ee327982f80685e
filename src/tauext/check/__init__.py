"""Checks of recordings and robot file before training.

Input: recordings and a rigid-body tree. Output: findings, each with its numbers and a remedy. Faults stop a training.
It imports `files`, `robot`, `data`, `bundle` and the core.
"""
