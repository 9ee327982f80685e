"""Robot files: URDF or MJCF to the rigid-body tree that the core computes with.

Input: a robot file and a choice of joints. Output: links, frames, capsules and torque limits, or a URDF written from
them. It imports `files` and the core.
"""
