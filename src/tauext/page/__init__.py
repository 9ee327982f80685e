"""The page of a live arm in the browser, real or simulated.

In go the files of a commissioned folder and the lines of the loop. Out come one HTML page, JSON and control lines. It
imports the packages before it.
"""
