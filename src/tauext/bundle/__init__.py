"""The bundle as a file, in words and in units, and what ties it to a recording.

In go bundle files, recordings and estimates of the core. Out come loaded bundles, sentences about them, checked pairs
of bundle and recording, and tables of estimates. It imports `files`, `robot`, `data` and the core.
"""
