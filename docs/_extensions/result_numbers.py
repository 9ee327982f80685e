"""The role {num}: a number from a results file, read while the site is built, so that no page repeats it by hand.

    {num}`FILE#PATH`                      the value as it is
    {num}`FILE#PATH|FORMAT`               in a format of Python: .2f, .0%, and ,d for thousands
    {num}`FILE#PATH|FORMAT|SEPARATOR`     a list, each element in that format, joined by the separator
    {num}`FILE#PATH over PATH|FORMAT`     the first value divided by the second
    {num}`FILE#PATH of PATH|FORMAT`       95 % interval of a share, from the number of events and of trials: 92 to 96%

FILE is a JSON file, relative to docs/. PATH is a sequence of keys separated by dots. In a list, [0] selects an element
by its index and [key=value] the one element whose key has that value:

    {num}`results/full/results.json#bundles[name=exact].free_motion.l1_nm|.2f|/`

In a table write \\| for |, as Markdown requires. A missing file, a path that selects nothing or no number, and a format
that does not fit stop the build.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scipy.special import betaincinv

STEP = re.compile(r"\.?(?P<key>[^.\[\]]+)|\[(?P<index>\d+)\]|\[(?P<field>[^=\]]+)=(?P<wanted>[^\]]+)\]")


class NumberError(ValueError):
    """The text of a role that selects no number, and why."""


def select(value: Any, path: str) -> Any:
    """The value at this path.

    Raises:
        NumberError: the path is malformed, or selects nothing.
    """
    at = 0
    while at < len(path):
        step = STEP.match(path, at)
        if step is None:
            raise NumberError(f"cannot parse '{path[at:]}' in '{path}'")
        here = path[at : step.end()]
        try:
            if step["key"] is not None:
                value = value[step["key"]]
            elif step["index"] is not None:
                value = value[int(step["index"])]
            else:
                (value,) = (item for item in value if str(item[step["field"]]) == step["wanted"])
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise NumberError(f"'{here}' in '{path}' does not select one value") from error
        at = step.end()
    return value


def shown(value: Any, form: str) -> str:
    """A number in a format, with a minus sign in place of a hyphen."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise NumberError(f"{value!r} is not a number")
    try:
        return format(value, form).replace("-", "−")
    except ValueError as error:
        raise NumberError(f"format '{form}' does not fit {value!r}") from error


def share_interval(events: Any, trials: Any) -> tuple[float, float]:
    """95 % interval of a share [Clopper and Pearson].

    Raises:
        NumberError: they are not counts of 0 <= events <= trials, trials > 0.
    """
    counts = all(isinstance(count, int) and not isinstance(count, bool) for count in (events, trials))
    if not counts or not 0 <= events <= trials or trials == 0:
        raise NumberError(f"{events!r} of {trials!r} is no share of counts")
    low = betaincinv(events, trials - events + 1, 0.025) if events else 0.0
    high = betaincinv(events + 1, trials - events, 0.975) if events < trials else 1.0
    return float(low), float(high)


def number(text: str, load: Callable[[str], Any]) -> str:
    """What the role shows.

    Args:
        text: of the role.
        load: returns the content of a JSON file.

    Raises:
        NumberError: the text selects no number.
    """
    source, *options = " ".join(text.split()).split("|", 2)  # a long one may continue on the next line
    form, by = options[0] if options else "", options[1] if len(options) == 2 else None
    name, found, paths = source.partition("#")
    if not found:
        raise NumberError("no path: write FILE#PATH")
    data = load(name)
    events, of, trials = paths.partition(" of ")
    if of:
        low, high = (shown(end, form) for end in share_interval(select(data, events), select(data, trials)))
        return f"{low.removesuffix('%')} to {high}"
    first, over, second = paths.partition(" over ")
    value = select(data, first)
    if over:
        try:
            value = value / select(data, second)
        except (TypeError, ZeroDivisionError) as error:
            raise NumberError(f"'{paths}' is no quotient of two numbers") from error
    if by is None:
        return shown(value, form)
    if not isinstance(value, list):
        raise NumberError(f"'{first}' is no list and takes no separator")
    return by.join(shown(item, form) for item in value)


def load_json(path: Path) -> Any:
    """Raises NumberError where there is no such file."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise NumberError(f"{path} cannot be read ({error})") from error


_loaded: dict[Path, tuple[int, Any]] = {}


def load_once(path: Path) -> Any:
    """As load_json; a file that has not changed since is not read again."""
    changed_ns = path.stat().st_mtime_ns if path.exists() else 0
    if path not in _loaded or _loaded[path][0] != changed_ns:
        _loaded[path] = (changed_ns, load_json(path))
    return _loaded[path][1]


def setup(app: Any) -> dict[str, bool]:
    from docutils import nodes  # here, so that tests need no Sphinx
    from sphinx.errors import ExtensionError

    def role(kind: str, source: str, text: str, line: int, inliner: Any, *_: Any) -> tuple[list[Any], list[Any]]:
        environment = inliner.document.settings.env

        def load(name: str) -> Any:
            path = Path(environment.srcdir) / name
            environment.note_dependency(str(path))
            return load_once(path)

        try:
            return [nodes.Text(number(text, load))], []
        except NumberError as error:
            raise ExtensionError(f"{environment.docname}, line {line}: {{{kind}}}`{text}`: {error}") from error

    app.add_role("num", role)
    return {"parallel_read_safe": True}
