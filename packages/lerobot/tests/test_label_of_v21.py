# ruff: noqa: E402
"""lerobot 0.3 and its v2.1: a dataset that it wrote is labelled, and it reads what was written."""

from __future__ import annotations

from pathlib import Path

import lerobot_arm as arms
import numpy as np
import pytest

module = pytest.importorskip("lerobot.datasets.lerobot_dataset", exc_type=ImportError)
if module.CODEBASE_VERSION != "v2.1":
    pytest.skip(f"this lerobot writes {module.CODEBASE_VERSION}", allow_module_level=True)

from tauext_lerobot.labels import label_dataset

import tauext
from tauext.data.description import load_arm

ADDED = ["shoulder.tau_ext", "elbow.tau_ext", "wrist.tau_ext", "contact", "collision"]
NAMES = [f"{name}.pos" for name in arms.MOTORS]


@pytest.mark.parametrize("into", ["state", "features"])
def test_old_lerobot_reads_what_was_labelled(trained: Path, tmp_path: Path, into: str):
    features = {name: {"dtype": "float32", "shape": (3,), "names": NAMES} for name in ("observation.state", "action")}
    dataset = module.LeRobotDataset.create("test/arm", arms.FPS, features, root=tmp_path / "old", use_videos=False)
    for state, action in arms.episodes(range(100, 103), 240, wall=True):
        for one, other in zip(state, action, strict=True):
            dataset.add_frame({"observation.state": one, "action": other}, task="follow")
        dataset.save_episode()
    bundle, arm = tauext.load_bundle(trained / "arm.tauext"), load_arm(trained / "arm.toml")
    report = label_dataset(tmp_path / "old", bundle, arm, tmp_path / "new", into)
    assert report.frames == 720 and report.contact > 0
    old = module.LeRobotDataset("test/arm", root=tmp_path / "old")
    new = module.LeRobotDataset("test/arm", root=tmp_path / "new")
    assert new.num_episodes == 3 and new.num_frames == 720
    before, after = np.asarray(old.hf_dataset["observation.state"]), np.asarray(new.hf_dataset["observation.state"])
    np.testing.assert_array_equal(after[:, :3], before)
    if into == "features":
        assert new[5]["observation.tau_ext"].shape == (3,) and new[5]["observation.contact"].shape in ((), (1,))
        return
    assert list(new.features["observation.state"]["names"]) == [*NAMES, *ADDED] and new[5][
        "observation.state"
    ].shape == (8,)
    from lerobot.datasets.compute_stats import compute_episode_stats

    for number in range(3):
        rows = after[240 * number : 240 * (number + 1)]
        own = compute_episode_stats({"observation.state": rows}, new.features)["observation.state"]
        held = new.meta.episodes_stats[number]["observation.state"]
        for kind, value in own.items():
            np.testing.assert_allclose(held[kind], value, atol=1e-5)
    for kind in ("mean", "std", "min", "max"):
        whole = getattr(after, kind)(axis=0)
        np.testing.assert_allclose(new.meta.stats["observation.state"][kind], whole, atol=1e-4)
