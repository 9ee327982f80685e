"""Bundles on recordings with known contacts.

In go bundles and a dataset. Out come estimates and results.json. It imports the packages before it.
"""
