"""A bundle on samples, recorded or live.

Input: samples and a bundle. Output: estimates, events, explanations, flights, places, loads and reactions. It imports
the packages before it.
"""
