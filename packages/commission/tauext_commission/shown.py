"""What `tauext show` and `tauext report` do with folders of commissioned arms."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from tauext.cli.arguments import print_replaced
from tauext.cli.show import lines
from tauext.errors import ConfigError
from tauext.progress import aligned, in_plain_letters
from tauext_commission.history import describe_folder, write_arms, write_history
from tauext_commission.history_file import is_commissioned


def show_folder(folder: Path, as_json: bool) -> None:
    """Print the state and the history of a commissioned arm."""
    content = describe_folder(folder)
    if as_json:
        print(json.dumps(content, indent=1))
        return
    history, missing = content.pop("history"), content.pop("missing")
    rows = [*lines(content), *(f"{joint}: {'; '.join(words)}" for joint, words in missing.items())]
    rows += ["", "history", *(f"  {one['wall']}  {one['words']}" for one in history)]
    print("\n".join(in_plain_letters(row) for row in rows))


def report_folders(folders: Sequence[Path], out: Path) -> None:
    """Draw the history of one commissioned arm, or print and draw a table of several."""
    for folder in folders:
        if not is_commissioned(folder):
            raise ConfigError(f"{folder}: is no folder of `tauext commission`; for results give --results and --data")
    page = out / ("history.html" if len(folders) == 1 else "arms.html")
    print_replaced(page)
    out.mkdir(parents=True, exist_ok=True)
    if len(folders) == 1:
        write_history(folders[0], out)
    else:
        rows = write_arms(folders, out)
        printed = aligned([row[:-1] for row in rows])
        printed += [f"{name}: {warnings}" for name, *_, warnings in rows[1:] if warnings]
        print("\n".join(map(in_plain_letters, printed)))
    print(page)
