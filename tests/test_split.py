"""Sets of whole recordings: none empty, none shared, and a split file that is refused where it lies."""

from __future__ import annotations

import json

import pytest

from tauext.data.dataset import Split, load_split, save_split, split_recordings
from tauext.errors import ConfigError

NAMES = [f"free-{k:03d}.parquet" for k in range(40)]


def test_every_recording_is_in_one_set_and_the_shares_are_the_papers():
    split = split_recordings(NAMES, seed=1, collisions=["collisions-000.parquet"])
    assert (len(split.train), len(split.validation), len(split.test)) == (28, 6, 6)
    assert sorted(split.train + split.validation + split.test) == NAMES
    assert split.collisions == ("collisions-000.parquet",)


def test_a_split_depends_on_the_seed_and_not_on_the_order_of_names():
    first = split_recordings(NAMES, seed=1)
    assert split_recordings(reversed(NAMES), seed=1) == first
    assert split_recordings(NAMES, seed=2) != first


@pytest.mark.parametrize("count", range(3, 25))
def test_no_set_is_empty_however_few_recordings_there_are(count):
    split = split_recordings(NAMES[:count], seed=0, minimum=3)
    assert min(len(split.train), len(split.validation), len(split.test)) >= 1
    assert len(split.train) + len(split.validation) + len(split.test) == count


def test_fewer_than_twenty_recordings_are_refused():
    with pytest.raises(ConfigError, match="19 recordings of free motion are too few to split: at least 20 are needed"):
        split_recordings(NAMES[:19], seed=0)
    with pytest.raises(ConfigError, match="2 recordings .* at least 3 are needed"):
        split_recordings(NAMES[:2], seed=0, minimum=1)


@pytest.mark.parametrize("fractions", [(0.7, 0.2, 0.2), (1.0, 0.0, 0.0), (0.7, 0.3)])
def test_fractions_that_are_not_shares_are_refused(fractions):
    with pytest.raises(ConfigError, match="must be three numbers > 0"):
        split_recordings(NAMES, seed=0, fractions=fractions)


def test_a_name_in_two_sets_or_with_a_folder_is_refused():
    with pytest.raises(ConfigError, match="'a' is in 'train' and in 'test'; a recording belongs to one set only"):
        Split(train=("a",), validation=("b",), test=("a",))
    with pytest.raises(ConfigError, match="'a' is twice in 'train'"):
        Split(train=("a", "a"), validation=(), test=())
    with pytest.raises(ConfigError, match="must be a file name without a folder"):
        Split(train=("../a",), validation=(), test=())


@pytest.fixture
def dataset(tmp_path):
    split = split_recordings(NAMES, seed=3)
    for name in NAMES:
        (tmp_path / name).touch()
    save_split(split, tmp_path)
    return tmp_path, split


def test_a_split_file_keeps_the_split(dataset):
    folder, split = dataset
    assert load_split(folder) == split
    assert sorted(p.name for p in folder.iterdir()) == [*NAMES, "split.json"]


def break_split(folder, **entries) -> None:
    path = folder / "split.json"
    content = json.loads(path.read_text()) | entries
    path.write_text(json.dumps({k: v for k, v in content.items() if v is not None}))


FAULTS = {
    "name in two sets": ({"validation": [NAMES[0]], "train": [NAMES[0]], "test": []}, "in 'train' and in 'validation'"),
    "missing recording": ({"test": ["gone.parquet"]}, "'gone.parquet' in 'test' does not exist in"),
    "missing set": ({"train": None}, "train is missing; it must be a list, each text"),
    "misspelt set": (
        {"colisions": []},
        "unknown key 'colisions'; the nearest known is 'collisions'; known are train, validation, test",
    ),
    "text for a list": ({"test": "a"}, "test = 'a' must be a list, each text"),
    "number for a name": ({"collisions": [3]}, "collisions = [3] must be a list, each text"),
    "newer": ({"format": 2}, "format 2 instead of 1: made by a development version before 0.1.0"),
    "no format": ({"format": None}, "its 'format' is missing, must be 1"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_split_file_is_refused_by_name(fault, dataset):
    folder, _ = dataset
    entries, message = FAULTS[fault]
    break_split(folder, **entries)
    with pytest.raises(ConfigError) as caught:
        load_split(folder)
    assert str(caught.value).startswith(f"{folder / 'split.json'}: ")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [(None, "there is no such file"), ("{", "not readable as JSON"), ("[]", ".*its 'format' is missing")],
)
def test_a_missing_or_garbled_split_file_is_refused_by_name(tmp_path, text, message):
    if text is not None:
        (tmp_path / "split.json").write_text(text)
    with pytest.raises(ConfigError, match=rf"split\.json: {message}"):
        load_split(tmp_path)
