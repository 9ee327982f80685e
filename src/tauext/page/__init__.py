"""The live page in the browser: a simulated arm that is pushed with the mouse.

In go a simulated arm and trained bundles. Out comes a page that shows estimates, alarms and places. It imports the
packages before it.
"""
