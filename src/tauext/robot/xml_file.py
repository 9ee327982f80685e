"""Robot files as XML: elements with the lines at which they begin."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

from tauext.errors import RobotError
from tauext.files.plain_file import expect_file


@dataclass(frozen=True)
class XmlFile:
    path: Path
    root: ElementTree.Element
    """Tags and attributes keep their prefixes as written: `drake:gear_ratio`."""
    lines: dict[ElementTree.Element, int]

    def error(self, element: ElementTree.Element, text: str) -> RobotError:
        """The error that names the file, the element's line and this text."""
        return RobotError(f"{self.path}, line {self.lines[element]}: {text}")


def read_xml(path: Path) -> XmlFile:
    """Read a robot file.

    What other readers of robot files accept is accepted: prefixes without a namespace, `--` in comments, blanks and
    comments before the declaration, bytes that are not of the declared encoding (UTF-8 is tried, then Latin-1).

    Raises:
        RobotError: the file is missing, cannot be read, or is no XML.
    """
    if not path.exists():
        raise RobotError(f"{path}: no such file; a robot is a URDF or MJCF file")
    try:
        expect_file(path)
        content = _tolerated(path.read_bytes())
    except OSError as error:
        raise RobotError(f"{path}: cannot be read: {error.strerror}") from error
    failed: list[Exception] = []
    for encoding in (None, "utf-8", "iso-8859-1"):
        try:
            file = XmlFile(path, *_parsed(content, encoding))
            for element in file.lines:
                if re.search(r"[\x00-\x1f\x7f-\x9f]", name := element.get("name", "")):
                    raise file.error(element, f"the name {ascii(name)} has characters that cannot be printed")
            return file
        except (expat.ExpatError, ValueError, LookupError) as error:
            failed.append(error)
    raise RobotError(f"{path}: not readable as XML: {failed[0]}") from failed[0]


def _tolerated(content: bytes) -> bytes:
    """The file without comments, and without a declaration that does not come first; lines stay."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):  # UTF-16
        return content
    content = re.sub(rb"<!--.*?-->", lambda comment: b"\n" * comment[0].count(b"\n"), content, flags=re.DOTALL)
    return re.sub(rb"\A((?:\xef\xbb\xbf)?\s+)<\?xml[^>]*\?>", rb"\1", content)


def _parsed(content: bytes, encoding: str | None) -> tuple[ElementTree.Element, dict[ElementTree.Element, int]]:
    builder, lines = ElementTree.TreeBuilder(), {}
    parser = expat.ParserCreate(encoding)
    parser.buffer_text = True

    def start(tag: str, attributes: dict[str, str]) -> None:
        lines[builder.start(tag, attributes)] = parser.CurrentLineNumber

    parser.StartElementHandler = start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.Parse(content, True)
    return builder.close(), lines
