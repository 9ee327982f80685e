"""A bundle on samples, recorded or live.

In go samples and a bundle. Out come estimates, events, explanations, flights, places, loads and reactions. It imports
the packages before it.
"""
