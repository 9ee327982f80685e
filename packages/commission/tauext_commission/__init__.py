"""One command from a bare arm to a monitored arm.

In go samples of a live source. Out comes one folder: description, recordings, labels, bundles with their history,
events and a log. The loop, the training and the page are separate processes that exchange files.
"""

from tauext.cli.commands import Command, Folders

COMMAND = Command(
    "learn a live arm while it works, and monitor it",
    "tauext_commission.command:commission",
    title="Monitor",
    folders=Folders(
        "commission.json",
        show="tauext_commission.shown:show_folder",
        report="tauext_commission.shown:report_folders",
        socket="tauext_commission.history_file:control_socket",
    ),
)
"""`tauext commission`, found by its entry point."""
