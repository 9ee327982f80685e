"""Sources of samples: robots and replay; other kinds come from plug-ins.

Input: addresses and settings of a controller or recording. Output: samples in the monitor's units. The package imports
`monitor` and the packages before it.
"""
