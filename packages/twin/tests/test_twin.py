"""A twin's values against the arm that moved, its files as MuJoCo, Pinocchio and USD read them, and bad input."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest
from made_recordings import Drive, made_motion
from tauext_twin.arm import read_arm, smooth
from tauext_twin.held_out import rollout_errors
from tauext_twin.model_file import Inertial, JointChange, given_of, write_model
from tauext_twin.posterior import OF_LINK, find_posterior, link_basis
from tauext_twin.twin import changed_model, warnings_of

from tauext import _core
from tauext.check.joint_fit import delayed
from tauext.cli import main
from tauext.config import TrainConfig
from tauext.data.dataset import Split, load_dataset, save_split
from tauext.data.free_motion import cut
from tauext.data.recording_file import save_recording
from tauext.robot.inertial import inertial_parameters
from tauext.robot.read import load_tree
from tauext.train.stage import train_bundle

ROTORS = (0.4, 0.3, 0.05)
TOOL_KG, TOOL_FAR = 0.8, 1.8
"""Of the way to the last link's centre of mass."""
URDF = """<?xml version="1.0"?>
<!-- a maker's arm -->
<robot name="arm">
  <link name="base"/>
{links}</robot>
"""
LINK = """  <!-- joint {k} -->
  <joint name="j{k}" type="revolute">
    <parent link="{parent}"/><child link="l{k}"/>
    <origin xyz="0 0 {up}" rpy="0 0 0"/><axis xyz="{axis}"/>
    <limit lower="-3" upper="3" effort="200" velocity="3"/>
  </joint>
  <link name="l{k}">
    <inertial><origin xyz="0 0.01 {com}" rpy="0.1 0 0"/><mass value="{mass}"/>
      <inertia ixx="0.04" iyy="0.05" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="meshes/l{k}.stl"/></geometry></visual>
  </link>
"""


def urdf() -> str:
    rows = [("base", 0.2, "0 0 1", 0.05, 4), ("l1", 0.1, "0 1 0", 0.2, 5), ("l2", 0.4, "0 1 0", 0.15, 2)]
    names = ("parent", "up", "axis", "com", "mass")
    return URDF.format(
        links="".join(LINK.format(k=k + 1, **dict(zip(names, row, strict=True))) for k, row in enumerate(rows))
    )


def true_tree(robot: Path) -> _core.Tree:
    """The file's arm with rotors and, on its last link, a ball that the file lacks."""
    tree = load_tree(robot)
    links = tree.links
    for link, rotor in zip(links, ROTORS, strict=True):
        link.rotor_inertia = rotor
    own, ball = links[-1], TOOL_FAR * np.array(links[-1].com)
    own.mass, own.com = (
        own.mass + TOOL_KG,
        ((own.mass * np.array(own.com) + TOOL_KG * ball) / (own.mass + TOOL_KG)).tolist(),
    )
    return _core.Tree(links, tree.gravity)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder with arm.urdf, data/ and bundle.tauext; the true damping and frictionloss, (2, 3), of the sharp Coulomb
    friction that comes closest to the smooth one that acted."""
    folder = tmp_path_factory.mktemp("twin")
    robot, data = folder / "arm.urdf", folder / "data"
    robot.write_text(urdf())
    motion = made_motion(true_tree(robot), 4.0, 200.0, drive=Drive(load=0.0))
    data.mkdir()
    (data / "robot.urdf").write_text(urdf())
    for recording in motion.recordings:
        save_recording(recording, data / f"{recording.name}.parquet")
    names = [f"{recording.name}.parquet" for recording in motion.recordings]
    save_split(Split(train=tuple(names[:3]), test=tuple(names[3:])), data)
    train_bundle(load_dataset(data), folder / "bundle.tauext", config=TrainConfig(recipe="prior"), check=False)
    dq = np.concatenate([recording.dq for recording in motion.recordings[:3]])
    friction = np.concatenate(motion.friction[:3])
    truth = [
        np.linalg.lstsq(np.column_stack([dq[:, j], np.tanh(dq[:, j] / 0.003)]), friction[:, j], rcond=None)[0]
        for j in range(3)
    ]
    return folder, np.array(truth).T


@cache
def twin(folder: Path, out: str, *more: str) -> dict:
    command = ["twin", str(folder / "bundle.tauext"), "--robot", str(folder / "arm.urdf"), "--out", str(folder / out)]
    assert main([*command, *more]) == 0
    return json.loads((folder / out).with_suffix(".twin.json").read_text())


def test_values_lie_within_their_errors_of_the_arm_that_moved(made):
    folder, (damping, loss) = made
    joints = twin(folder, "own/twin.urdf")["joints"].values()
    for truth, what in ((damping, "damping"), (loss, "frictionloss"), (ROTORS, "armature")):
        found = np.array([[one[what]["value"], one[what]["standard_error"]] for one in joints]).T
        assert all(one[what]["written"] for one in joints)
        # Three standard errors, and 8 %: what comes closest depends on how samples near zero speed count, and a link's
        # change is linear, while the ball adds its mass times the square of its distance, 0.01 kg m^2.
        np.testing.assert_array_less(np.abs(found[0] - truth), 3 * found[1] + 0.08 * np.abs(truth), err_msg=what)
        assert (found[1] < 0.2 * np.abs(truth)).all(), what
    first, _, last = joints
    assert not first["mass"]["written"] and first["mass"]["value"] == 4.0
    true = true_tree(folder / "arm.urdf").links[-1]
    # Gravity shows the moment about the joint; mass and place alone are less sure.
    moment = last["mass"]["value"] * np.hypot(last["com_x"]["value"], last["com_y"]["value"])
    assert last["mass"]["written"] and moment == pytest.approx(true.mass * np.hypot(*true.com[:2]), rel=0.03)


def test_the_twin_explains_torques_and_positions_that_it_is_not_made_of(made):
    content = twin(made[0], "own/twin.urdf")
    for one in content["torque"].values():
        assert one["rmse_twin"] < 0.25 * one["rmse_file"]
    ends = content["rollout"]["rms_end_rad"]["0.2"]
    assert (np.array(ends["twin"]) < 0.25 * np.array(ends["file"])).all()
    assert not content["warnings"]  # this arm's friction is viscous and Coulomb
    held = {"load share": 0.3, "Stribeck": 0.9}
    odd = {"j": {"unit": "N m", "rmse_file": 1.0, "rmse_twin": 1.5, "not_held": held}}
    joints = {"j": {"armature": {"value": 0.0, "standard_error": 0.1}}}
    worse, unseen, misleads = warnings_of(odd, joints)
    assert "exceeds that of the file" in worse and "j: the motion does not show the rotor inertia" in unseen
    assert "load share explains 30%" in misleads
    page = (made[0] / "own/twin.html").read_text()
    assert "j3" in page and "armature" in page and page.count("data:image/png;base64,iVBOR") == 2


def test_files_keep_the_users_text_and_other_programs_read_the_values(made):
    folder = made[0]
    joints = twin(folder, "own/twin.urdf")["joints"]
    text = (folder / "own/twin.urdf").read_text()
    assert "<!-- a maker's arm -->" in text and "<!-- joint 2 -->" in text and 'filename="../meshes/l3.stl"' in text
    pin = pinocchio.buildModelFromUrdf(str(folder / "own/twin.urdf"))
    np.testing.assert_allclose(pin.friction, [one["frictionloss"]["value"] for one in joints.values()], rtol=1e-5)
    np.testing.assert_allclose(pin.damping, [one["damping"]["value"] for one in joints.values()], rtol=1e-5)
    assert pin.inertias[3].mass == pytest.approx(joints["j3"]["mass"]["value"], rel=1e-5)
    twin(folder, "own/twin.xml")
    model = mujoco.MjModel.from_xml_path(str(folder / "own/twin.xml"))
    noise = twin(folder, "own/twin.xml")["noise"]
    assert model.sensor("twin_jointvel_j2").id >= 0 and model.nsensor == 9
    assert model.sensor_noise == pytest.approx(np.ravel([noise[of] for of in ("q", "dq", "tau")], order="F"), rel=1e-5)
    assert model.dof_armature == pytest.approx([one["armature"]["value"] for one in joints.values()], rel=1e-5)
    assert model.dof_frictionloss == pytest.approx([one["frictionloss"]["value"] for one in joints.values()], rel=1e-5)


def test_an_mjcf_keeps_comments_and_takes_in_its_includes(tmp_path):
    (tmp_path / "part.xml").write_text(
        "<x><!-- part --><body name='b'><joint name='j' axis='0 0 1'/><geom size='.1'/></body></x>"
    )
    (tmp_path / "arm.xml").write_text(
        "<!-- head --><mujoco><worldbody><include file='part.xml'/></worldbody>"
        "<sensor><jointvel name='own' joint='j' noise='7'/></sensor></mujoco>"
    )
    body = Inertial("b", 2.0, (0.0, 0.0, 0.1), (0.01, 0.02, 0.02), (1.0, 0, 0, 0))
    change = JointChange("j", 0.5, 1.5, 0.25, body, noise=(0.01, 0.02, 0.03))
    added = write_model(tmp_path / "arm.xml", tmp_path / "out.xml", [change], "a -- note")
    text = (tmp_path / "out.xml").read_text()
    assert "<!-- head -->" in text and "<!-- part -->" in text and "include" not in text
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    assert (model.dof_frictionloss[0], model.dof_armature[0], model.body_mass[1]) == (1.5, 0.25, 2.0)
    assert added == ["twin_jointpos_j", "twin_jointactuatorfrc_j"]  # behind the file's own sensor, which stays
    assert [model.sensor(k).name for k in range(model.nsensor)] == ["own", *added]
    assert model.sensor_noise.tolist() == [7, 0.01, 0.03]
    np.testing.assert_allclose(model.body_ipos[1], (0, 0, 0.1))
    (given,) = given_of(tmp_path / "out.xml", load_tree(tmp_path / "out.xml"))
    assert given.tolist() == [0.5, 1.5, 0.25, 0.0]


def test_usd_is_read_back(made):
    usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
    from pxr import UsdPhysics

    joints = twin(made[0], "usd/twin.usda")["joints"]
    stage = usd.Stage.Open(str(made[0] / "usd/twin.usda"))
    prim = stage.GetPrimAtPath("/arm/j2")
    assert prim.GetAttribute("physxJoint:armature").Get() == pytest.approx(joints["j2"]["armature"]["value"], rel=1e-5)
    damping = UsdPhysics.DriveAPI(prim, "angular").GetDampingAttr().Get()
    assert damping == pytest.approx(joints["j2"]["damping"]["value"] * np.pi / 180, rel=1e-5)
    mass = UsdPhysics.MassAPI(stage.GetPrimAtPath("/arm/l3")).GetMassAttr().Get()
    assert mass == pytest.approx(joints["j3"]["mass"]["value"], rel=1e-5)
    assert [str(path) for path in UsdPhysics.RevoluteJoint(prim).GetBody0Rel().GetTargets()] == ["/arm/l1"]


def test_a_users_own_stage_stays_and_a_layer_over_it_has_the_values(made, capsys):
    usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
    folder = made[0]
    joints = twin(folder, "usd/twin.usda")["joints"]
    before = (folder / "usd/twin.usda").read_bytes()
    command = ["twin", str(folder / "bundle.tauext"), "--robot", str(folder / "usd/twin.usda"), "--out"]
    assert main([*command, str(folder / "layers/over.usda")]) == 0
    assert (folder / "usd/twin.usda").read_bytes() == before
    layer = (folder / "layers/over.usda").read_text()
    assert 'over "j2"' in layer and "../usd/twin.usda" in layer
    stage = usd.Stage.Open(str(folder / "layers/over.usda"))
    found = stage.GetPrimAtPath("/arm/j2").GetAttribute("physxJoint:jointFriction").Get()
    assert found == pytest.approx(joints["j2"]["frictionloss"]["value"], rel=1e-5)
    assert main([*command, str(folder / "layers/over.xml")]) == 2
    assert "MJCF cannot be written from twin.usda (USD)" in capsys.readouterr().err
    assert main([*command, str(folder / "layers/a.usda"), "--names", "j1=shoulder"]) == 2
    assert "no joint 'shoulder'" in capsys.readouterr().err
    assert sorted(path.name for path in (folder / "layers").iterdir()) == ["over.html", "over.twin.json", "over.usda"]


def test_draws_spread_as_the_errors_state_and_repeat_with_their_seed(made):
    folder = made[0]
    stated = twin(folder, "draws/twin.xml", "--draws", "60", "--seed", "3")["joints"]
    models = [mujoco.MjModel.from_xml_path(str(folder / f"draws/twin-{k:03d}.xml")) for k in range(60)]
    for j, one in enumerate(stated.values()):
        spread = np.std([model.dof_frictionloss[j] for model in models])
        # The standard deviation of 60 draws has an error of 9 %.
        assert spread == pytest.approx(one["frictionloss"]["standard_error"], rel=0.4)
    before = (folder / "draws/twin-003.xml").read_bytes()
    (folder / "draws/twin-003.xml").unlink()
    twin(folder, "draws/twin.xml", "--draws", "8", "--seed", "3")
    assert (folder / "draws/twin-003.xml").read_bytes() == before


def test_a_torque_that_lags_is_found_and_widens_the_error_of_rotor_inertias(made):
    arm = read_arm(made[0] / "bundle.tauext", made[0] / "arm.urdf", None, {})
    late = [replace(one, tau=delayed(one.tau, -0.01, one.rate_hz)) for one in arm.training]
    before, after = find_posterior(arm), find_posterior(replace(arm, training=late))
    np.testing.assert_allclose(before.lag_s, 0.0, atol=1e-3)
    np.testing.assert_allclose(after.lag_s, 0.01, atol=2e-3)
    # A lag of d hides d times the damping, 3.5 N m s/rad at joint 2.
    apart = np.abs(after.values(after.mean) - before.values(before.mean))[:, 2]
    assert apart[1] > 0.02 and (apart < 2 * after.standard_errors(0)[:, 2]).all()


def test_motion_is_smoothed_on_each_side_of_a_gap_by_itself(made):
    one = load_dataset(made[0] / "data").training()[0]
    half = one.samples // 2
    t_ns = one.t_ns + np.where(np.arange(one.samples) < half, 0, 3600 * 10**11)  # a hundred hours
    gap, parts = smooth(replace(one, t_ns=t_ns)), [cut(one, slice(0, half)), cut(one, slice(half, None))]
    for what in ("q", "dq"):
        alone = np.concatenate([getattr(smooth(part), what) for part in parts])
        np.testing.assert_allclose(getattr(gap, what), alone, atol=1e-12)
    assert gap.t_ns == pytest.approx(t_ns, abs=1e6) and np.abs(gap.dq - one.dq).max() < 0.1


def test_link_basis_is_the_derivative_of_the_parameters(made):
    tree, step = load_tree(made[0] / "arm.urdf"), 1e-6
    basis = link_basis(tree)
    for k, link in enumerate(tree.links):
        for column, what in enumerate(OF_LINK):
            changed, before = tree.links[k], inertial_parameters(link)
            if what == "mass":
                changed.mass += step
            elif what in "xyz":
                com = list(changed.com)
                com["xyz".index(what)] += step / link.mass
                changed.com = com
            elif what == "inertia":
                changed.inertia = [(1 + step) * x for x in link.inertia]
            else:
                changed.rotor_inertia += step
            slope = (inertial_parameters(changed) - before) / step
            np.testing.assert_allclose(basis[11 * k : 11 * k + 11, 6 * k + column], slope, atol=1e-5, err_msg=what)


def test_friction_that_a_simulator_can_hold_is_itself_and_no_value_is_negative(made):
    folder, _ = made
    arm = read_arm(folder / "bundle.tauext", folder / "arm.urdf", None, {})
    posterior = find_posterior(arm)
    x = np.zeros(len(posterior.mean))
    for viscous, coulomb in posterior.sliding:
        x[viscous], x[coulomb] = -0.7, -2.0
    np.testing.assert_allclose(posterior.friction(x), np.tile([0.7, 2.0], (3, 1)), rtol=1e-6)
    assert (posterior.friction(-x) == 0).all() and (posterior.values(-10 * posterior.mean)[:, :4] >= 0).all()
    exact, _ = changed_model(arm, [JointChange(f"j{k + 1}", 0.0, 0.0, rotor) for k, rotor in enumerate(ROTORS)])
    strong = [replace(one, tau=one.tau * 1e9) for one in arm.test]
    assert not np.isfinite(rollout_errors(replace(arm, test=strong), exact, None)[5.0]).any()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--out", "a.step"], "must end in one of .xml"),
        (["--out", "arm.urdf"], "it is the robot file"),
        (["--out", "a.xml", "--names", "j1"], "must be RECORDED=FILE"),
        (["--out", "a.xml", "--names", "j9=j1"], "no such joint was recorded; they are j1, j2, j3"),
        (["--out", "a.xml", "--names", "j1=shoulder"], "no joint 'shoulder'; its joints are j1, j2, j3"),
        (["--out", "a.xml", "--robot", "other.urdf"], "is another arm's file"),
        (["--out", "a.xml", "--robot", "mimic.urdf"], "follows 'j1' (mimic)"),
        (["--out", "a.xml", "--data", "nothing"], "nothing"),
        (["--out", "a.xml", "--draws", "-1"], "0 to 100000"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(made, monkeypatch, capsys, more, message):
    monkeypatch.chdir(made[0])
    Path("damaged").mkdir(exist_ok=True)  # a neighbour that is none of the arm's
    Path("damaged/split.json").write_text("{")
    Path("other.urdf").write_text(urdf().replace('xyz="0 0 0.4"', 'xyz="0 0 0.6"'))
    Path("mimic.urdf").write_text(urdf().replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><mimic joint="j1"/>', 1))
    given = [] if "--robot" in more else ["--robot", "arm.urdf"]
    before = sorted(Path().iterdir())
    assert main(["twin", "bundle.tauext", *given, *more]) == 2
    printed = capsys.readouterr().err.strip().splitlines()
    assert message in printed[-1] and sorted(Path().iterdir()) == before


def test_a_bundle_without_a_model_and_one_without_its_recordings_are_refused(made, tmp_path, capsys):
    folder, _ = made
    plain = TrainConfig(recipe="observer")
    given = load_dataset(folder / "data")
    train_bundle(given, tmp_path / "none.tauext", "none", config=plain, check=False, accept=["limit-wide"])
    assert main(["twin", str(tmp_path / "none.tauext"), "--out", str(tmp_path / "a.xml")]) == 2
    assert "it has no model of the arm, or no prior" in capsys.readouterr().err
    (tmp_path / "far").mkdir()
    alone = tmp_path / "far/bundle.tauext"
    alone.write_bytes((folder / "bundle.tauext").read_bytes())
    assert main(["twin", str(alone), "--out", str(tmp_path / "a.xml")]) == 2
    assert "name their folder with --data" in capsys.readouterr().err
