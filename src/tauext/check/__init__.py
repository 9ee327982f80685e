"""What recordings and robot file have wrong, before anything is learned from them.

In go recordings and a rigid-body tree. Out come findings, each with its numbers and a remedy; faults refuse a training.
It imports `files`, `robot`, `data`, `bundle` and the core.
"""
