"""One command from a bare arm to a monitored arm.

In go samples of a live source. Out comes one folder: description, recordings, labels, bundles with their history,
events and a log. The loop, the training and the page are separate processes that exchange files. It imports the
packages before it.
"""
