"""The file of a cell as a whole: the examples of the pages, and what every command refuses at its start."""

from __future__ import annotations

import pytest
from doc_pages import Page

from tauext.errors import ConfigError
from tauext.monitor.cell_file import load_cell

JOINTS = ("shoulder", "elbow", "wrist_1", "wrist_3_joint")


def test_the_tables_of_the_pages_are_one_file(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text("\n".join(text for page in ("running.md", "contacts.md") for text in Page(page).blocks("toml")))
    cell = load_cell(path, JOINTS)
    names = [reaction.name for reaction in cell.reactions]
    assert names[:4] == ["stop the arm", "log", "lamp", "open the clamp"] and len(names) == 5
    assert cell.profiles.named("pressing").collision.tolist() == [1.5, 1.5, 1.5, 2.0]
    assert cell.profiles.start == "normal" and cell.profiles.named("carrying").load.mass == 2.8
    assert list(cell.phases.by_name) == ["sanding", "insertion", "grip"]
    assert [name for name, *_ in cell.phases.scheduled(0)] == ["sanding", "grip"] and cell.bus is None
    assert load_cell(path).reactions == cell.reactions  # of joints that are not known yet


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[reaction.a]",
            "unknown key 'reaction'; the nearest known is 'reactions'; known are profiles, ",
        ),
        ("phases = 3", r"cell.toml: phases = 3 must be a table"),
        ("bus = 3", r"cell.toml: bus = 3 must be a table"),
        ("[profiles]\nlowest = 1\nhighest = 1", r"\[profiles\] start = '' must be one of the tables \[profiles.NAME\]"),
    ],
)
def test_a_file_that_breaks_a_rule_says_which(tmp_path, text, message):
    path = tmp_path / "cell.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_cell(path, JOINTS)


def test_a_file_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none.toml: there is no such file; docs/running\.md has an example"):
        load_cell(tmp_path / "none.toml")
