"""Bundles on recordings with known contacts.

Reads bundles and a dataset; writes estimates and results.json. Imports the packages before it.
"""
