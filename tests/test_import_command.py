"""`tauext import`: from files and a description to a dataset folder that training takes."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from made_arms import PLANAR_RIG, planar_rig, random_states, six_axis, urdf
from made_recordings import JOINT_STATES, joint_rows, motion, write_bag
from test_capsules import stl, tube

from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.data.dataset import load_split
from tauext.data.description import parse_arm
from tauext.data.free_motion import free_stretches
from tauext.data.importing import RawFacts, plan
from tauext.data.recording_file import load_recording
from tauext.errors import ConfigError, RobotError
from tauext.robot.capsules import link_capsules
from tauext.robot.read import load_tree, movable_joints
from tauext.robot.write import Payload, write_placeholder, write_robot

ARM = PLANAR_RIG + "{robot}\n" + JOINT_STATES + "{rest}\n"


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Three bags of 20, 30 and 40 s."""
    folder = tmp_path_factory.mktemp("bags")
    for k, name in enumerate(("one", "two", "three")):
        write_bag(folder / name, "ros1", {"/joint_states": joint_rows(("tip", "base"), 1000 * (k + 2))})
    return folder


LOOKED_AT = (
    "test_training_takes_what_an_import_wrote",
    "test_a_dataset_without_a_model_is_trained_without_one_and_goes_through_every_command",
)


DRAWN = ("test_training_takes_what_an_import_wrote",)
"""Whose pictures are drawn in earnest."""


@pytest.fixture(autouse=True)
def seldom_examined(request):
    """What is imported is looked at in the end, which takes most of the time, and is the subject of few tests."""
    if request.node.name not in LOOKED_AT:
        request.getfixturevalue("unexamined")
    if request.node.name not in DRAWN:
        request.getfixturevalue("undrawn")


@pytest.fixture
def workplace(tmp_path, bags):
    """A folder with a robot file and the bags."""
    (tmp_path / "arm.urdf").write_text(urdf(planar_rig()))
    for bag in bags.iterdir():
        (tmp_path / bag.name).symlink_to(bag)
    return tmp_path


def run(capsys, workplace, rest: str = "", robot: str = "", sources=("one", "two", "three"), extra=()):
    (workplace / "arm.toml").write_text(ARM.format(rest=rest, robot=robot))
    files = [str(workplace / f"{name}.bag") for name in sources]
    capsys.readouterr()
    code = main(
        ["import", "--source", *files, "--arm", str(workplace / "arm.toml"), "--out", str(workplace / "out"), *extra]
    )
    return code, *capsys.readouterr()


def spans(workplace) -> dict[str, list[tuple[str, float, float]]]:
    """Part: source, first and last time of each of its recordings, [s]."""
    found: dict = {}
    split = load_split(workplace / "out")
    for part in ("train", "validation", "test", "collisions"):
        for name in getattr(split, part):
            t_ns = load_recording(workplace / "out" / name).t_ns - motion(1)[0][0]
            source = load_recording(workplace / "out" / name).source.split(".")[0]
            found.setdefault(part, []).append((source, round(t_ns[0] * 1e-9, 3), round(t_ns[-1] * 1e-9, 3)))
    return found


def test_few_sources_are_each_split_by_time_with_a_gap_and_that_is_reported(workplace, capsys):
    code, out, _ = run(capsys, workplace)
    assert code == 0 and out.splitlines()[-1] == str(workplace / "out")
    assert (
        "3 sources without labelled contacts: each split by time (train 80%, test 20%) with a gap of 2 s" in out
        and "validation is empty: train finds thresholds by cross-validation on the training motion" in out
    )
    found = spans(workplace)
    assert "validation" not in found
    assert [found[part][-1] for part in ("train", "test")] == [("three", 0.0, 30.99), ("three", 33.0, 39.99)]
    recording = load_recording(workplace / "out/three-train.parquet")
    np.testing.assert_array_equal(recording.q[:, 1], motion(3100, joints=2)[1][:, 0])  # tip is elbow, sent first
    assert not (workplace / "out/three.parquet").exists()
    assert json.loads((workplace / "out/run.json").read_text())["settings"]["sources"] == [
        "one.bag",
        "two.bag",
        "three.bag",
    ]


def test_sources_too_short_to_be_split_serve_whole_and_that_is_reported(workplace, capsys):
    code, out, _ = run(capsys, workplace, "[split]\ngap_s = 8")
    assert code == 0 and "too short to be split by time, whole in train: one" in out  # 4 s of it less half the gap
    assert spans(workplace)["train"][0] == ("one", 0.0, 19.99)


def test_listed_stretches_are_taken_and_nothing_is_held_back(workplace, capsys):
    code, out, _ = run(
        capsys, workplace, '[split]\ntrain = ["one.bag"]\ntest = ["two.bag[0:15]"]\ncollisions = ["two.bag[15:]"]'
    )
    assert code == 0 and "validation is empty" in out
    assert "in no set: three" in out
    found = spans(workplace)
    assert found["train"] == [("one", 0.0, 19.99)] and "validation" not in found
    assert found["test"] == [("two", 0.0, 14.99)] and found["collisions"] == [("two", 15.0, 29.99)]


def test_recordings_with_contacts_go_whole_to_collisions(workplace, capsys):
    code, out, _ = run(capsys, workplace, '[contact.intervals]\n"two.bag" = [[5, 6]]')
    assert code == 0 and "collisions: two.parquet" in out
    assert {source for part in ("train", "test") for source, *_ in spans(workplace)[part]} == {"one", "three"}


def test_contacts_are_cut_out_of_training_where_it_is_listed(workplace, capsys):
    rest = '[split]\ntrain = ["two.bag"]\nvalidation = ["one.bag"]\ntest = ["three.bag"]\n[contact]\nafter_s = 2\n'
    assert run(capsys, workplace, rest + '[contact.intervals]\n"two.bag" = [[5, 6]]')[0] == 0
    assert spans(workplace)["train"] == [("two", 0.0, 4.49), ("two", 8.01, 29.99)]
    assert all((load_recording(p).contact == 0).all() for p in (workplace / "out").glob("two-free-*.parquet"))


def test_with_cut_false_a_listed_recording_keeps_its_contacts_and_their_label(workplace, capsys):
    rest = '[split]\ntrain = ["two.bag"]\nvalidation = ["one.bag"]\ntest = ["three.bag"]\n[contact]\ncut = false\n'
    assert run(capsys, workplace, rest + '[contact.intervals]\n"two.bag" = [[5, 6]]')[0] == 0
    assert load_split(workplace / "out").train == ("two.parquet",)
    contact = load_recording(workplace / "out" / "two.parquet").contact
    assert 0 < (contact == 1).sum() < len(contact)


def test_where_every_source_has_contacts_the_end_is_kept_whole_for_collisions(workplace, capsys):
    rest = '[contact.intervals]\n"three.bag" = [[2, 2.5], [35, 35.5]]'
    assert run(capsys, workplace, rest, sources=["three"])[0] == 0
    found = spans(workplace)
    assert found["collisions"] == [("three", 31.0, 39.99)]
    assert found["train"] == [("three", 3.51, 28.99)]  # 1.5 s before the touch are too short
    assert found["test"] == [("three", 31.0, 34.49), ("three", 36.51, 39.99)]


def test_training_takes_what_an_import_wrote(workplace, capsys):
    """The bags' torque is none of this arm's, which both say."""
    code, out, err = run(capsys, workplace)
    assert code == 0 and out.splitlines()[-1] == str(workplace / "out")
    for words in (
        "out: 1 fault, which `tauext train` refuses",
        "robot-file-other: the robot file seems to be of another arm",
        "tauext check",
    ):
        assert words in err
    bundle = workplace / "prior.tauext"
    train = ["train", "--data", str(workplace / "out"), "--recipe", "prior", "--out", str(bundle)]
    assert main(train) == 2 and not bundle.exists()
    capsys.readouterr()
    assert main([*train, "--accept", "robot-file-other"]) == 2 and not bundle.exists()  # some seconds of motion
    assert f"{bundle}: 1 fault, so its thresholds are refused" in capsys.readouterr().err
    assert main([*train, "--accept", "robot-file-other", "limit-wide"]) == 0
    facts = json.loads(load_bundle(bundle).provenance)
    assert {one["code"] for one in facts["limit_findings"]} == {"limit-wide"}


def test_a_dataset_without_a_model_is_trained_without_one_and_goes_through_every_command(workplace, capsys, undrawn):
    arm = ARM.replace('model = "arm.urdf"\n', "")
    (workplace / "arm.toml").write_text(arm.format(rest="", robot=""))
    out, files = workplace / "out", [str(workplace / f"{name}.bag") for name in ("two", "three")]
    assert main(["import", "--source", *files, "--arm", str(workplace / "arm.toml"), "--out", str(out)]) == 0
    assert "robot: no model" in capsys.readouterr().out
    bundle, results = workplace / "made.tauext", workplace / "results"
    train = ["train", "--data", str(out), "--recipe", "friction", "--out", str(bundle), "--accept", "limit-wide"]
    assert main([*train, "--case", "mass"]) == 2 and not bundle.exists()
    assert "case = mass needs a model, and" in capsys.readouterr().err
    assert main(train) == 0 and "the dataset has no model, so the case is 'none'" in capsys.readouterr().err
    assert main(["show", str(bundle), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["provenance"]["case"] == "none" and said["masses_kg"] == [0, 0]
    assert main(["check", "--data", str(out)]) in (0, 1)
    assert capsys.readouterr().out.startswith("no robot model: ")
    assert main(["check", "--data", str(out), "--json"]) in (0, 1)
    codes = {finding["code"] for finding in json.loads(capsys.readouterr().out)["findings"]}
    assert not codes & {"model-unusable", "inertia-impossible", "payload", "effort-scale"}
    evaluate = ["evaluate", "--data", str(out), "--out", str(results)]
    assert main([*evaluate, "--baselines", "--methods", "observer", "--case", "exact"]) == 2
    assert main([*evaluate, "--bundles", str(bundle), "--baselines", "--methods", "observer"]) == 0
    report = ["report", "--results", str(results), "--data", str(out), "--out", str(workplace / "report")]
    assert main(report) == 0
    # The made torques know nothing of that model.
    with_robot = [*train, "robot-file-other", "--robot", str(workplace / "arm.urdf"), "--case", "mass"]
    assert main(with_robot) == 0  # a model given beside the dataset is one


def test_payload_rotor_inertia_and_gravity_reach_the_robot_file(workplace, capsys):
    robot = "rotor_inertia_kg_m2 = [1e-4, 2e-4]\ngear_ratio = [100, 50]\ngravity_m_s2 = [9.81, 0, 0]"
    rest = '[payload]\nlink = "elbow_link"\nmass_kg = 1.5\ncom_m = [0.1, 0, 0]'
    code, out, _ = run(capsys, workplace, rest, robot)
    assert (
        code == 0 and "rotor inertia at the joint, kg m^2: 1, 0.5" in out and "payload of 1.5 kg at elbow_link" in out
    )
    before, after = load_tree(workplace / "arm.urdf"), load_tree(workplace / "out/robot.urdf")
    assert after.gravity == [9.81, 0, 0]
    assert [link.rotor_inertia for link in after.links] == pytest.approx([1.0, 0.5])
    assert after.links[1].mass == pytest.approx(before.links[1].mass + 1.5)


def test_shapes_stay_with_the_dataset_and_missing_meshes_are_reported(workplace, capsys):
    arm = workplace / "arm.urdf"
    shapes = '<collision><geometry><cylinder radius="0.05" length="0.4"/></geometry></collision></link>'
    mesh = '<collision><geometry><mesh filename="meshes/none.stl"/></geometry></collision></link>'
    first, second, rest = arm.read_text().split("</link>")
    arm.write_text(first + shapes + second + mesh + rest)
    code, out, _ = run(capsys, workplace)
    assert code == 0 and (
        "there is no mesh file meshes/none.stl; give their folder with --meshes FOLDER (import, train); "
        "places of touches there follow from guessed shapes" in out
    )
    kept = json.loads((workplace / "out/robot.shapes.json").read_text())
    ((_, (capsule,)),) = kept["bodies"].items()
    assert capsule["radius_m"] == 0.05 and len(kept["notes"]) == 1
    capsules, notes = link_capsules(workplace / "out/robot.urdf", load_tree(workplace / "out/robot.urdf"))
    assert len(capsules) == 1 and notes == kept["notes"]


def test_meshes_given_at_import_or_at_training_give_the_links_their_shapes(workplace, capsys):
    """The remedy that the message names, by both commands, and a wrong folder, which both refuse before their work."""
    mesh = '<collision><geometry><mesh filename="package://cell_arm/meshes/tube.stl"/></geometry></collision></link>'
    (workplace / "arm.urdf").write_text((workplace / "arm.urdf").read_text().replace("</link>", mesh))
    right, wrong = workplace / "elsewhere", workplace / "empty"
    (right / "cell_arm/meshes").mkdir(parents=True)
    (right / "cell_arm/meshes/tube.stl").write_bytes(stl(tube(0.05, 0.4)))
    wrong.mkdir()
    code, _, err = run(capsys, workplace, extra=("--meshes", str(wrong)))
    assert code == 2 and f"--meshes {wrong}: none of the 1 meshes of arm.urdf is there" in err
    code, out, _ = run(capsys, workplace)
    assert code == 0 and "with --meshes FOLDER (import, train), or put package cell_arm beside the robot file" in out
    train = ["train", "--data", str(workplace / "out"), "--recipe", "observer"]
    train += ["--accept", "robot-file-other", "limit-wide"]

    def capsules(*words: str) -> int:
        assert main([*train, "--out", str(workplace / "arm.tauext"), *words]) == 0
        return len(load_bundle(workplace / "arm.tauext").capsules)

    assert main([*train, "--out", str(workplace / "arm.tauext"), "--meshes", str(wrong)]) == 2
    assert capsules() == 0
    guessed = "the shapes of 2 of 2 links are guessed, and so are places of touches on "
    assert f"{guessed}shoulder, elbow: shapes of " in capsys.readouterr().err
    assert capsules("--meshes", f"cell_arm={right / 'cell_arm'}") == 2
    assert "guessed" not in capsys.readouterr().err
    shutil.rmtree(workplace / "out")
    code, out, _ = run(capsys, workplace, extra=("--meshes", str(right)))
    assert code == 0 and "guessed" not in out and capsules() == 2
    bare = workplace / "out/robot.urdf"
    bare.write_text(bare.read_text().replace(mesh, "</link>"))
    (workplace / "out/robot.shapes.json").unlink()
    assert capsules() == 0
    assert f"{guessed}shoulder, elbow: the robot file has no geometry for them; import with" in capsys.readouterr().err
    shutil.rmtree(workplace / "out")
    (workplace / "arm.toml").write_text(ARM.replace('model = "arm.urdf"\n', "").format(rest="", robot=""))
    words = ["--source", str(workplace / "one.bag"), "--arm", str(workplace / "arm.toml"), "--meshes", str(right)]
    assert main(["import", *words, "--out", str(workplace / "out")]) == 2
    assert "names no robot file (model), so no mesh is read" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["urdf", "mjcf"])
def test_a_payload_weighs_what_a_point_mass_does(tmp_path, kind):
    # Potential energy of a point mass at the flange: its gravity torque is -m g dz/dq, by differences of its height.
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(six_axis()))
    link = "joint6_link"
    if kind == "mjcf":
        import mujoco

        path = tmp_path / "arm.xml"
        mujoco.MjModel.from_xml_path(str(tmp_path / "arm.urdf"))
        mujoco.mj_saveLastXML(str(path), mujoco.MjModel.from_xml_path(str(tmp_path / "arm.urdf")))
    heavy = write_robot(path, _folder(tmp_path), {}, Payload(link, 2.0, (0.1, 0.2, 0.3), (0,) * 6))
    q, _ = random_states(6, 20, seed=0)
    still = np.zeros_like(q)
    extra = load_tree(heavy).momentum(q, still)[1] - load_tree(path).momentum(q, still)[1]
    import mujoco

    spec = mujoco.MjSpec.from_file(str(path))
    next(b for b in spec.bodies if b.name == link).add_site(name="load", pos=[0.1, 0.2, 0.3])
    model = spec.compile()
    data = mujoco.MjData(model)

    def height(at):
        data.qpos[:] = at
        mujoco.mj_kinematics(model, data)
        return data.site("load").xpos[2]

    step = 1e-6
    slope = [[(height(at + step * e) - height(at - step * e)) / (2 * step) for e in np.eye(6)] for at in q]
    np.testing.assert_allclose(extra, 2.0 * 9.81 * np.array(slope), rtol=0, atol=1e-7)


def _folder(tmp_path):
    folder = tmp_path / "dataset"
    folder.mkdir()
    return folder


def test_a_robot_file_without_changes_is_copied_and_a_wrong_name_refused(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(six_axis()))
    folder = _folder(tmp_path)
    assert write_robot(path, folder, {}).read_bytes() == path.read_bytes()
    with pytest.raises(RobotError, match="no link 'tool'; "):
        write_robot(path, folder, {}, Payload("tool", 1.0, (0, 0, 0), (0,) * 6))
    with pytest.raises(RobotError, match="no joint 'joint9'; similar: joint"):
        write_robot(path, folder, {"joint9": (1.0, 1.0)})


def test_a_placeholder_has_no_momentum_and_no_weight(tmp_path):
    tree = load_tree(write_placeholder(("a", "b", "c"), tmp_path))
    assert movable_joints(tmp_path / "robot.urdf") == ["a", "b", "c"]
    q, dq = random_states(3, 20, seed=0)
    momentum, bias = tree.momentum(q, dq)
    assert np.abs(momentum).max() < 1e-7 and np.abs(bias).max() < 1e-7


def test_an_import_that_fails_leaves_nothing_and_a_full_folder_is_refused(workplace, capsys):
    code, _, err = run(capsys, workplace, '[split]\ntrain = ["four.bag"]')
    assert code == 2 and "'four.bag' is none of the sources: one.bag, two.bag, three.bag" in err
    code, _, err = run(capsys, workplace, '[split]\ntrain = ["one.bag", "two.bag[31:]"]')
    assert code == 2 and "[split] 'two.bag[31:]' must begin before the end of 'two.bag', at 30" in err
    assert not [p for p in workplace.iterdir() if p.name.startswith("out")]
    (workplace / "out").mkdir()
    assert run(capsys, workplace)[0] == 0
    code, _, err = run(capsys, workplace)
    assert code == 2 and "is not empty" in err


WRONG_INTERVALS = {
    "no such file": ('"tow.bag" = [[5, 6]]', "'tow.bag' is none of the sources: one.bag, two.bag, three.bag"),
    "begins behind the end": (
        '"two.bag" = [[31, 31.5]]',
        "'two.bag' = [31, 31.5] must lie within the recording, 0 to 30 s",
    ),
    "ends behind the end": (
        '"three.bag" = [[2, 3], [4, 60]]',
        "'three.bag' = [4, 60] must lie within the recording, 0 to 40",
    ),
    "begins before it": ('"one.bag" = [[-1, 2]]', "'one.bag' = [-1, 2] must lie within the recording, 0 to 20 s"),
}


@pytest.mark.parametrize("fault", WRONG_INTERVALS)
def test_a_contact_that_is_in_no_recording_is_refused_and_nothing_is_left(fault, workplace, capsys):
    """Its motion would be trained on as free."""
    interval, words = WRONG_INTERVALS[fault]
    code, _, err = run(capsys, workplace, f"[contact.intervals]\n{interval}")
    assert code == 2 and words in err and len(err.splitlines()) == 1
    assert not [p for p in workplace.iterdir() if p.name.startswith("out")]


def test_contacts_of_a_recording_that_is_not_imported_now_are_left_alone(workplace, capsys):
    """One arm.toml serves for later imports; only a mistyped name is refused."""
    contacts = '[contact.intervals]\n"three.bag" = [[2, 2.5]]'
    code, out, _ = run(capsys, workplace, contacts, sources=("one", "two"))
    assert code == 0 and "contacts of three.bag are not used: it is not among the sources" in out


def test_a_mistyped_recording_gets_a_suggestion(workplace, capsys):
    code, _, err = run(capsys, workplace, '[contact.intervals]\n"tow.bag" = [[5, 6]]')
    assert code == 2 and "did you mean 'two.bag'?" in err


def test_a_contact_may_end_a_little_after_its_recording(workplace, capsys):
    assert run(capsys, workplace, '[contact.intervals]\n"two.bag" = [[28, 30.5]]')[0] == 0


def test_new_writes_a_description_that_imports_once_its_open_entries_are_filled_in(workplace, capsys):
    new = workplace / "new.toml"
    arguments = ["--source", str(workplace / "one.bag"), "--robot", str(workplace / "arm.urdf")]
    assert main(["import", "--new", str(new), *arguments]) == 0
    text, out = new.read_text(), str(workplace / "out")
    assert 'model = "arm.urdf"' in text and 'names = ["?", "?"]' in text and "the recording also has tip, base" in text
    assert main(["import", "--new", str(new), *arguments]) == 2  # nothing is overwritten
    assert main(["import", "--source", str(workplace / "three.bag"), "--arm", str(new), "--out", out]) == 2
    assert "[robot] names has '?'" in capsys.readouterr().err and not (workplace / "out").exists()
    new.write_text(text.replace('["?", "?"]', '["tip", "base"]'))
    assert main(["import", "--source", str(workplace / "three.bag"), "--arm", str(new), "--out", out]) == 0
    capsys.readouterr()
    assert main(["import", "--source", out]) == 2 and "--arm is missing" in capsys.readouterr().err


def test_plans_follow_the_number_of_sources():
    described = parse_arm('[robot]\njoints = ["a"]\n[signals.q]\ncolumns = "q"\n[signals.tau]\ncolumns = "tau"')
    many = {f"run{k}": RawFacts(60.0, k >= 8) for k in range(10)}
    claims, said = plan(described, many, {})
    assert {c.set_name: sum(o.set_name == c.set_name for o in claims) for c in claims} == {
        "collisions": 2, "train": 6, "validation": 1, "test": 1,
    }  # fmt: skip
    assert said[0] == "8 sources without labelled contacts, split as whole recordings"
    with pytest.raises(ConfigError, match="run: 8.0 s are too short to be split by time into parts"):
        plan(described, {"run": RawFacts(8.0, False)}, {})


def test_one_stretch_in_two_sets_is_refused():
    described = parse_arm(
        '[robot]\njoints = ["a"]\n[signals.q]\ncolumns = "q"\n[signals.tau]\ncolumns = "tau"\n'
        '[split]\ntrain = ["run.csv[:30]"]\ntest = ["run.csv[20:]"]'
    )
    with pytest.raises(ConfigError, match=r"share a stretch of run \(run\[0:30\], run\[20:\]\)"):
        plan(described, {"run": RawFacts(60.0, False)}, {"run.csv": ["run"]})


def test_a_recording_without_contacts_is_its_own_free_stretch(workplace, capsys):
    run(capsys, workplace)
    recording = load_recording(workplace / "out/two-train.parquet")
    assert free_stretches(recording, 0.5, 1.0, 2.0) == [recording]


def test_an_array_of_hdf5_that_is_too_short_is_named_with_its_length(workplace, capsys):
    import h5py

    _, q, dq, tau = motion(joints=2)
    with h5py.File(workplace / "run.h5", "w") as file:
        for name, values in {"position": q, "velocity": dq, "effort": tau[:-7]}.items():
            file[name] = values
    (workplace / "arm.toml").write_text(ARM.format(rest="", robot=""))
    options = ("--arm", str(workplace / "arm.toml"), "--out", str(workplace / "out"))
    assert main(["import", "--source", str(workplace / "run.h5"), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "arrays of another length than 400 left out: effort (393)" in line
    assert not (workplace / "out").exists()
