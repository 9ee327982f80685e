"""Results to figures and pages.

In go results.json, estimates and flights. Out come figures and HTML pages. It imports the packages before it and
computes nothing that results.json could hold.
"""
