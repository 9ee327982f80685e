"""Where the demo shows a touch to be: against where an arm without friction is pushed, and how it is drawn and said."""

from types import SimpleNamespace

import numpy as np
import pytest
from made_bundles import constant_error_scale
from made_page import SMOOTH_ARM, smooth_bundle

from tauext import _core
from tauext.page.drawing import PlaceDrawing, span
from tauext.page.simulation import Simulation
from tauext.page.snapshot import Place, Placed, Places, Verdict, outward, place_words
from tauext.robot.capsules import link_capsules

LIMIT_NM, SIGMA_NM = 3.0, 0.3


@pytest.fixture(scope="module")
def bundles(tmp_path_factory):
    """An observer that says how sure it is, and one that does not."""
    folder = tmp_path_factory.mktemp("places")
    bundle, tree = smooth_bundle(folder, LIMIT_NM)
    bundle.save(str(folder / "deaf.tauext"))
    bundle.error_scale = constant_error_scale([SIGMA_NM] * tree.size)
    bundle.capsules = link_capsules(folder / "robot.xml", tree)[0]
    bundle.save(str(folder / "tauext.tauext"))
    return {name: str(folder / f"{name}.tauext") for name in ("tauext", "deaf")}


@pytest.fixture
def simulation(bundles):
    """It moves on whatever is said, its monitors warm."""
    made = Simulation(SMOOTH_ARM)
    made.watch_with(bundles, "tauext")
    made.set_reaction("ignore")
    run(made, 1.5)
    return made


def run(simulation, seconds):
    for _ in range(round(seconds * simulation.arm.rate_hz)):
        simulation.step()


def push(simulation, joint, across_m=0.3):
    """Push a point of this joint's link, on its surface, straight into it; the snapshot 0.4 s later."""
    plant = simulation.plant
    model, data = plant.model, plant.data
    geom = model.body_geomadr[joint + 1]
    turn = data.geom_xmat[geom].reshape(3, 3)
    normal = turn[:, 0]
    point = data.geom_xpos[geom] + normal * model.geom_size[geom][0]
    simulation.grab("test", joint, point)
    simulation.pull("test", point - across_m * normal)
    run(simulation, 0.4)
    return simulation.snapshot()


@pytest.mark.parametrize("joint", [3, 6])
def test_the_first_place_is_where_the_hand_pushes(simulation, joint):
    assert simulation.snapshot().placed is None
    shown = push(simulation, joint)
    true, placed = shown.touch, shown.placed
    assert placed.links[0][0] == joint and sum(share for _, share in placed.links) == pytest.approx(1)
    first = placed.places[0]
    assert first.joint == joint and first.pushes
    assert np.linalg.norm(first.point_m - true.point_m) < 0.05
    assert np.linalg.norm(first.force_n - true.force_n) < 0.25 * np.linalg.norm(true.force_n)
    for k, rival in enumerate(placed.places[1:], 1):
        assert all(np.linalg.norm(rival.point_m - one.point_m) > 1e-3 for one in placed.places[:k])
    assert placed.newtons == pytest.approx(np.linalg.norm(first.force_n))
    assert shown.verdicts["tauext"].force_n == placed.newtons and shown.places_refused == ""


def test_newtons_stay_until_the_alarm_ends_and_places_until_nobody_pushes(simulation):
    felt = push(simulation, 5).verdicts["tauext"].force_n
    simulation.release("test")
    run(simulation, 1.0)
    latched = simulation.snapshot()
    assert latched.placed is None
    assert latched.verdicts["tauext"].alarm == "collision" and latched.verdicts["tauext"].force_n == felt
    simulation.resume()
    run(simulation, 0.1)
    after = simulation.snapshot().verdicts["tauext"]
    assert after.alarm == "none" and np.isnan(after.force_n) and after.kind == "none"


def test_a_method_that_tells_no_place_says_why(simulation):
    simulation.set_method("deaf")
    shown = push(simulation, 5)
    assert shown.placed is None and "error scale" in shown.places_refused
    assert shown.verdicts["deaf"].alarm == "collision" and np.isnan(shown.verdicts["deaf"].force_n)
    assert not np.isnan(shown.verdicts["tauext"].force_n)


class Model:
    """Says what it is told to say."""

    refused, capsules = "", []

    def find(self, q, tau_ext, sigma_nm, near):
        shares = dict(enumerate(self.shares))
        ranked = sorted(shares, key=lambda link: -shares[link])
        places = [
            SimpleNamespace(
                link=link, probability=shares[link], point=[link, 0, 0], on_link=[0, 0, 0], force=[0, 0, 10]
            )
            for link in ranked
        ]
        return SimpleNamespace(probability=self.shares, ranked=ranked, places=places)


def test_the_first_link_stays_first_until_another_is_twice_as_probable(bundles):
    places, model = Places(_core.Bundle.load(bundles["tauext"])), Model()
    places._model = model
    felt = SimpleNamespace(
        held_alarm=_core.Alarm.contact,
        near_stiction=[False] * 7,
        tau_ext=[1.0] * 7,
        sigma_nm=[1.0] * 7,
        contact_sigma_nm=[1.0] * 7,
        load_nm=[0.0] * 7,
    )
    gone = SimpleNamespace(held_alarm=_core.Alarm.none)

    def first(shares, said=felt):
        model.shares = [*shares, 0.0, 0.0, 0.0, 0.0]
        placed = places.find(np.zeros(7), said)
        if placed is None:
            return None
        assert placed.places[0].joint == placed.links[0][0]
        assert [link for link, _ in placed.links[1:]] == sorted(
            set(range(7)) - {placed.links[0][0]}, key=lambda link: -model.shares[link]
        )
        return placed.links[0]

    assert first([0.6, 0.3, 0.1]) == (0, 0.6)
    assert first([0.35, 0.6, 0.05]) == (0, 0.35)
    assert first([0.25, 0.6, 0.15]) == (1, 0.6)
    assert first([0.45, 0.4, 0.15]) == (1, 0.4)
    assert first([0.45, 0.4, 0.15], gone) is None
    assert first([0.45, 0.4, 0.15]) == (0, 0.45)  # another touch begins anew


def test_outward_is_from_the_axis_of_the_capsule_that_the_point_lies_on():
    along_z, sphere = _core.Capsule(0, [0, 0, 0], [0, 0, 1], 0.1), _core.Capsule(0, [1, 0, 0], [1, 0, 0], 0.2)
    np.testing.assert_allclose(outward(np.array([0.1, 0, 0.4]), [along_z, sphere]), [0.1, 0, 0])
    np.testing.assert_allclose(outward(np.array([0, 0, 1.1]), [along_z, sphere]), [0, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(outward(np.array([1, -0.2, 0]), [along_z, sphere]), [0, -0.2, 0])


def place(joint=3, probability=0.8, force=(0.0, 0.0, -20.0), pushes=True):
    return Place(joint, probability, np.array([0.5, 0.0, 0.3]), np.array(force), pushes)


def test_an_arrow_points_at_a_push_and_leaves_a_pull():
    start, end = span(place())
    np.testing.assert_allclose(end, [0.5, 0.0, 0.3])
    np.testing.assert_allclose(start, [0.5, 0.0, 0.38])
    start, end = span(place(pushes=False))
    np.testing.assert_allclose(start, [0.5, 0.0, 0.3])
    np.testing.assert_allclose(end, [0.5, 0.0, 0.22])


class Scene:
    """Keeps what is put into it, by name."""

    def __init__(self):
        self.things = {}

    def add_mesh_simple(self, name, *_, **settings):
        return self.things.setdefault(name, SimpleNamespace(**settings))

    def add_label(self, name, text, **settings):
        return self.things.setdefault(name, SimpleNamespace(text=text, **settings))


def test_rivals_are_drawn_fainter_and_go_with_the_touch():
    scene, joints = Scene(), tuple(f"joint{k}" for k in range(1, 8))
    drawing = PlaceDrawing(scene, joints, (0.0, 0.0, 0.1))
    drawing.show(Placed(((3, 0.8), (4, 0.2)), (place(), place(4, 0.2, (0.0, 30.0, 0.0)))))
    label = [scene.things[f"/places/words{k}"] for k in range(3)]
    assert [one.text for one in label] == ["joint4: 20 N", "joint5 20%", " "]
    assert [one.visible for one in label] == [True, True, False]
    opacity = [scene.things[f"/places/{k}/shaft"].opacity for k in range(3)]
    assert opacity[0] is None and 1 > opacity[1] > opacity[2] > 0
    np.testing.assert_allclose(scene.things["/places/1/shaft"].position, [0.5, -0.12, 0.3])
    drawing.show(None)
    assert not any(one.visible for one in label)
    assert all(scene.things[f"/places/{k}/head"].position == (0.0, 0.0, 0.1) for k in range(3))


def test_words_name_link_rivals_kind_and_newtons():
    panel = pytest.importorskip("tauext.page.panel", reason="the page needs the extra tauext[live]")
    joints = tuple(f"joint{k}" for k in range(1, 8))
    placed = Placed(((3, 0.8), (4, 0.16), (5, 0.04)), (place(),))
    assert place_words(placed, joints) == "On the link of joint4 (80%; joint5 16%): 20 N."
    assert panel.seen(Verdict("ok", "none", -1)) == "nothing"
    assert panel.seen(Verdict("ok", "collision", 3, "unknown", 33.8)) == "collision, 34 N"
    assert panel.seen(Verdict("ok", "collision", 3, "clamp", 33.8)) == "clamp, 34 N"
    assert panel.seen(Verdict("ok", "contact", 3, "push")) == "push"
