"""Many arms: their stages as tasks, a prior for the next arm, a report over months.

In go folders of recordings, one an arm. Out come bundles, results, a fleet prior and a fleet report. It imports the
packages before it.
"""
