"""What force is noticed: a planar arm by hand, the joints' limits themselves, and the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from made_results import make_results

from tauext import _core
from tauext.calibrate import noticed_forces, spread_poses
from tauext.calibrate.noticed import facts_of, half_sphere
from tauext.cli import main
from tauext.errors import ConfigError
from tauext.report import write_report
from tauext.report.noticed_forces import noticed_table
from tauext.report.results_file import load_results

LENGTHS_M, LIMITS_NM = (0.5, 0.3), {"contact": (2.0, 1.0), "collision": (4.0, 1.5)}


def planar() -> _core.Bundle:
    """Two joints about the base's z, links along x; the second ends at the load's frame."""
    links = []
    for number, length in enumerate((0.0, LENGTHS_M[0])):
        link = _core.Link()
        link.joint_name, link.parent, link.mass = f"joint{number + 1}", number - 1, 1.0
        link.translation, link.inertia = [length, 0, 0], [0.01, 0.01, 0.01, 0, 0, 0]
        link.rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]
        links.append(link)
    bundle = _core.Bundle()
    bundle.links = links
    scale = _core.ErrorScaleSettings()
    scale.features = [_core.MotionFeature.constant]
    scale.limit_weights = scale.largest = scale.sigma_weights = scale.sigma_near_weights = scale.largest_sigma = [
        1.0,
        1.0,
    ]
    bundle.error_scale = scale
    bundle.contact_sliding_limit_nm, bundle.sliding_limit_nm = (list(LIMITS_NM[k]) for k in ("contact", "collision"))
    bundle.contact_near_stiction_limit_nm = [2 * one for one in LIMITS_NM["contact"]]
    bundle.near_stiction_limit_nm = [2 * one for one in LIMITS_NM["collision"]]
    load = _core.LoadSettings()
    load.frame, load.link, load.translation = "tip", 1, [LENGTHS_M[1], 0, 0]
    bundle.load_settings = load
    return bundle


def told(found, where: str, level: str = "collision", region: str = "in motion"):
    at = next(one for one in found if one.where == where)
    return next(one for one in at.forces if (one.level, one.region) == (level, region))


def test_a_planar_arm_by_hand():
    found = noticed_forces(planar(), np.array([[0.0, 0.0]]))
    assert [one.where for one in found] == ["link of joint1, at joint2", "tip"]
    # Stretched along x: y at the tip turns joint 1 by 0.8 m and joint 2 by 0.3 m; x and z turn none.
    tip = told(found, "tip")
    assert tip.by_axis_n["y"] == pytest.approx((min(4.0 / 0.8, 1.5 / 0.3),) * 2)
    assert tip.by_axis_n["x"] == (np.inf, np.inf) and tip.by_axis_n["z"] == (np.inf, np.inf)
    assert tip.worst_n == (np.inf, np.inf) and tip.blind_share == 1
    assert told(found, "tip", region="at rest").by_axis_n["y"][0] == pytest.approx(2 * tip.by_axis_n["y"][0])
    assert told(found, "tip", "contact").by_axis_n["y"][0] == pytest.approx(min(2.0 / 0.8, 1.0 / 0.3))
    assert told(found, "link of joint1, at joint2").by_axis_n["y"][0] == pytest.approx(4.0 / 0.5)


def test_median_and_worst_are_of_the_poses():
    # The elbow turns the second link: at 90 degrees x acts on joints 1 and 2 by 0.3 m, y on joint 1 by 0.5 m.
    poses = np.array([[0.0, 0.0], [0.0, np.pi / 2], [0.0, np.pi / 2]])
    tip = told(noticed_forces(planar(), poses), "tip")
    assert tip.by_axis_n["y"] == pytest.approx((8.0, 8.0))
    assert tip.by_axis_n["x"] == pytest.approx((5.0, np.inf))
    assert tip.blind_share == 1  # z is never seen


def test_a_force_just_above_it_exceeds_a_limit_and_one_just_below_none():
    bundle, rng = planar(), np.random.default_rng(1)
    model = _core.WrenchModel(bundle)
    for pose in rng.uniform(-2, 2, (20, 2)):
        noticed = told(noticed_forces(bundle, pose[None]), "tip").by_axis_n["y"][0]
        torque = np.abs(model.columns("tip", pose.tolist())[1]) / LIMITS_NM["collision"]
        assert (1.001 * noticed * torque).max() > 1 > (0.999 * noticed * torque).max()


def test_directions_are_even():
    ways = half_sphere(64)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1)
    assert (ways[:, 2] > 0).all()
    # Of an even sphere each square is a third; 64 points are that to a percent.
    np.testing.assert_allclose(np.mean(ways**2, axis=0), 1 / 3, atol=0.01)


def test_what_does_not_fit_is_refused_by_name():
    bundle = planar()
    with pytest.raises(ConfigError, match="frame 'flange' must be one of joint1, joint2, tip"):
        noticed_forces(bundle, np.zeros((1, 2)), ["flange"])
    for poses in (np.zeros((1, 3)), np.full((1, 2), np.nan), np.zeros((0, 2))):
        with pytest.raises(ConfigError, match="must be finite"):
            noticed_forces(bundle, poses)
    bundle.error_scale = _core.ErrorScaleSettings()
    with pytest.raises(ConfigError, match="error scale"):
        noticed_forces(bundle, np.zeros((1, 2)))


def test_facts_have_null_where_nothing_is_noticed():
    facts = facts_of(noticed_forces(planar(), np.zeros((1, 2))))
    force = facts[1]["forces"][0]
    assert force["by_axis_n"]["x"] == [None, None] and force["worst_direction_n"] == [None, None]
    json.dumps(facts, allow_nan=False)


def test_poses_are_spread_evenly_in_time():
    first, second = np.zeros((100, 2)), np.ones((300, 2))
    poses = spread_poses([first, second])
    assert len(poses) == 64 and np.mean(poses[:, 0]) == pytest.approx(0.75, abs=0.02)
    assert len(spread_poses([np.zeros((3, 2))])) == 3


def in_results(content: dict) -> None:
    facts = facts_of(noticed_forces(planar(), np.array([[0.0, 0.0], [0.2, 1.2]])))
    for bundle in content["bundles"]:
        bundle["forces_noticed"] = facts


def test_the_report_shows_them_and_a_damaged_entry_is_named(tmp_path):
    results, data = make_results(tmp_path, bundles=("exact",), seconds=12.0, test_recordings=1, collision_recordings=1)
    file = results / "results.json"
    content = json.loads(file.read_text())
    in_results(content)
    file.write_text(json.dumps(content))
    page = write_report(results, data, tmp_path / "report").read_text()
    assert "What force is noticed" in page and "link of joint1, at joint2" in page
    assert (tmp_path / "report" / "figures" / "force-noticed.png").stat().st_size > 5000
    table = noticed_table(load_results(results))
    assert table is not None and table.rows[1].cells[1] == "tip" and "never" in table.rows[1].cells[3]
    content["bundles"][0]["forces_noticed"][0]["forces"][0]["worst_direction_n"] = [1.0]
    file.write_text(json.dumps(content))
    with pytest.raises(ConfigError, match="'worst_direction_n' must be a list of 2 numbers"):
        load_results(results)


GOLDEN = Path(__file__).parent / "golden" / "format-8.tauext"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([str(GOLDEN), "--force"], "keeps no poses of its training; give recordings with --poses"),
        ([str(GOLDEN), "--frame", "tip"], "--frame and --poses belong to --force"),
        (["x.parquet", "--force"], "x.parquet: --force is said of bundles"),
    ],
)
def test_show_force_refuses_in_one_line(words, message, monkeypatch, capsys):
    file = Path(words[0])
    if not file.exists():
        monkeypatch.setattr(Path, "is_file", lambda self: True)
    assert main(["show", *words]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_show_force_tells_newtons_of_the_poses_given(tmp_path, capsys):
    bundle = _core.Bundle.load(str(GOLDEN))
    facts = json.loads(bundle.provenance)
    facts["poses"] = [[0.1, 0.2], [0.4, -0.8]]
    bundle.provenance = json.dumps(facts)
    file = tmp_path / "arm.tauext"
    file.write_bytes(bundle.to_bytes())
    assert main(["show", str(file), "--force"]) in (0, None)
    text = capsys.readouterr().out
    assert "median of 2 poses of the motion it was trained on" in text and "ISO/TS 15066" in text
    assert main(["show", str(file), "--force", "--json", "--frame", "elbow"]) in (0, None)
    content = json.loads(capsys.readouterr().out)
    expected = noticed_forces(bundle, np.array(facts["poses"]), ["elbow"])
    assert content["forces"] == facts_of(expected) and content["poses"] == 2
    assert main(["show", str(file), "--force", "--frame", "nose"]) == 2
    assert "frame 'nose' must be one of" in capsys.readouterr().err
