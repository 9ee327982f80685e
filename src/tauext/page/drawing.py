"""The arm in the browser: links, torque arcs, force arrows, and where it is touched."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser

from tauext.page.snapshot import SHOWN, Place, Placed, Snapshot, Touch, ball_radius_m
from tauext.sim.arms import DemoArm

# --- Arrows and rods whose shape never changes: they are moved, turned and stretched.


SECTIONS = 24
HEAD_RADII, HEAD_LENGTHS = 2.4, 5.0
"""Of an arrow's head, in radii of its shaft."""
NOTHING = 1e-4
"""Scale of an arrow that is not shown, [m]. It stays in the scene all the same: a browser makes the program that draws
a thing when it first draws it, and without a GPU that takes it half a second, in the middle of a push."""

NEWTON_M = 0.004
"""Length of an arrow for each newton, [m]."""


class Rod:
    """A round bar from one point to another."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        color: tuple[int, int, int],
        radius_m: float,
        park_m: tuple,
        opacity: float | None = None,
    ):
        """
        Args:
            park_m: where it waits while it is not shown, inside of something opaque.
            opacity: of a faint one, 0 to 1.
        """
        self._opacity = opacity
        self._radius, self._park, self._shown = radius_m, park_m, False
        self._shaft = self._add(scene, f"{name}/shaft", trimesh.creation.cylinder(1.0, 1.0, SECTIONS), color)
        self._parts = [self._shaft]

    def show(self, start: np.ndarray, end: np.ndarray) -> None:
        """Reach from start to end, (3,) each."""
        self._shown = True
        self._reach(self._shaft, start, end, self._radius)

    def hide(self) -> None:
        if self._shown:
            self._shown = False
            for part in self._parts:
                part.position, part.scale = self._park, NOTHING

    def _add(self, scene: viser.SceneApi, name: str, mesh: trimesh.Trimesh, color: tuple) -> viser.MeshHandle:
        """The mesh, of length 1 along z from the origin on."""
        mesh.apply_translation([0.0, 0.0, -mesh.bounds[0, 2]])
        return scene.add_mesh_simple(
            name,
            mesh.vertices,
            mesh.faces,
            color=color,
            cast_shadow=False,
            scale=NOTHING,
            position=self._park,
            opacity=self._opacity,
        )

    @staticmethod
    def _reach(part: viser.MeshHandle, start: np.ndarray, end: np.ndarray, radius_m: float) -> None:
        length = float(np.linalg.norm(end - start))
        part.position, part.scale = start, (radius_m, radius_m, max(length, NOTHING))
        part.wxyz = turn_from_z((end - start) / max(length, 1e-12))


class Arrow(Rod):
    """A rod with a head at its end; one shorter than its head shrinks as a whole."""

    def __init__(self, scene: viser.SceneApi, name: str, color: tuple[int, int, int], *how: Any, **options: Any):
        super().__init__(scene, name, color, *how, **options)
        self._head = self._add(scene, f"{name}/head", trimesh.creation.cone(1.0, 1.0, SECTIONS), color)
        self._parts.append(self._head)

    def show(self, start: np.ndarray, end: np.ndarray) -> None:
        self._shown = True
        length = float(np.linalg.norm(end - start))
        shrink = min(1.0, 0.5 * length / (HEAD_LENGTHS * self._radius))
        neck = end - (end - start) * (shrink * HEAD_LENGTHS * self._radius / max(length, 1e-12))
        self._reach(self._shaft, start, neck, shrink * self._radius)
        self._reach(self._head, neck, end, shrink * HEAD_RADII * self._radius)


def turn_from_z(direction: np.ndarray) -> np.ndarray:
    """Quaternion w, x, y, z of the shortest turn from z to a unit vector (3,); the zero vector turns nothing."""
    quaternion = np.array([1.0 + direction[2], -direction[1], direction[0], 0.0])
    length = np.linalg.norm(quaternion)
    return quaternion / length if length > 1e-6 else np.array([0.0, 1.0, 0.0, 0.0])


class Label:
    """Words in the scene; nothing is sent that has not changed."""

    def __init__(self, scene: viser.SceneApi, name: str, scale: float):
        self._handle = scene.add_label(name, " ", anchor="bottom-center", font_screen_scale=scale, visible=False)
        self._words = ""

    def show(self, words: str, position: Any = None) -> None:
        """Empty words hide it; position None: where it was."""
        if position is not None:
            self._handle.position = position
        if words != self._words:
            self._handle.text, self._handle.visible, self._words = words or " ", bool(words), words


# --- Arrows where a touch is taken to be: the most probable place, and fainter ones at its rivals.


ESTIMATE = (10, 60, 200)
OPACITY: tuple[float | None, ...] = (None, 0.4, 0.2)
RADIUS_M = (0.009, 0.007, 0.007)
ABOVE_M = 0.05
"""Of the words over the arrow's end."""


class PlaceDrawing:
    """One arrow and one label a place; show() moves them."""

    def __init__(self, scene: viser.SceneApi, joints: tuple[str, ...], park: tuple[float, float, float]):
        self._joints = joints
        self._arrows = [
            Arrow(scene, f"/places/{k}", ESTIMATE, RADIUS_M[k], park, opacity=OPACITY[k]) for k in range(SHOWN)
        ]
        self._labels = [Label(scene, f"/places/words{k}", scale) for k, scale in enumerate((1.1, 0.8, 0.8))]

    def show(self, placed: Placed | None) -> None:
        """Draw what explains the touch; None: nothing."""
        places = placed.places if placed is not None else ()
        for k, (arrow, label) in enumerate(zip(self._arrows, self._labels, strict=True)):
            if k < len(places):
                start, end = span(places[k])
                arrow.show(start, end)
                over = (start if places[k].pushes else end) + [0.0, 0.0, ABOVE_M]
                label.show(place_label(places[k], self._joints, first=k == 0), over)
            else:
                arrow.hide()
                label.show("")


def span(place: Place) -> tuple[np.ndarray, np.ndarray]:
    """Where its arrow begins and ends: a push's head is at the point, a pull's tail; no arrow hides in the link."""
    way = NEWTON_M * place.force_n
    return (place.point_m - way, place.point_m) if place.pushes else (place.point_m, place.point_m + way)


def place_label(place: Place, joints: tuple[str, ...], first: bool) -> str:
    """`joint4: 34 N`, of a rival `joint5 12%`."""
    if not first:
        return f"{joints[place.joint]} {place.probability:.0%}"
    return f"{joints[place.joint]}: {float((place.force_n**2).sum()) ** 0.5:.0f} N"


# --- The arm in the browser: links to grab, arcs of torque at the joints, arrows of force, words where it is touched.


PART, DRUM = (196, 202, 211), (78, 88, 104)
TOUCHED = {"contact": (245, 176, 30), "collision": (222, 44, 40)}
STEEL = (112, 122, 138)
TRUE, QUIET, SPRING = (10, 120, 50), (165, 172, 182), (120, 120, 120)
ARC_RAD = 2.0
"""Angle of an arc at its joint's limit, to either side."""
ARC_POINTS = 16
ARC_STEPS = 20
"""In so many steps up to the limit an arc grows: a new shape is work for the browser, and noise is not worth it."""
ARC_RADIUS_M = 0.105

Grab = Callable[[str, object, int, tuple[float, float, float]], None]
"""Called with the phase (start, update, end), who drags, the link's joint and where the pointer is."""


class Drawing:
    """The scene of one arm; show() moves it. Nothing is sent that has not changed."""

    def __init__(self, server: viser.ViserServer, arm: DemoArm, grab: Grab):
        self._scene, self._arm = server.scene, arm
        self._frames, self._parts, self._arcs = [], [], []
        self._levels = [""] * len(arm.joints)
        self._shares = [np.nan] * len(arm.joints)
        self._light(server)
        model = arm.model
        for j, joint in enumerate(arm.joints):
            name = f"/arm/{joint}"
            self._frames.append(self._scene.add_frame(name, show_axes=False))
            shapes: dict[str, list] = {"part": [], "drum": []}
            for g in np.flatnonzero(model.geom_bodyid == j + 1):
                kind = "drum" if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CYLINDER else "part"
                shapes[kind].append(shape_mesh(model, int(g)))
            for kind, color in (("part", PART), ("drum", DRUM)):
                mesh = trimesh.util.concatenate(shapes[kind])
                handle = self._scene.add_mesh_simple(f"{name}/{kind}", mesh.vertices, mesh.faces, color=color)
                self._make_grabbable(handle, j, grab)
                if kind == "part":
                    self._parts.append(handle)
            limit = arc(arm, j, np.linspace(-ARC_RAD, ARC_RAD, ARC_POINTS))
            self._scene.add_line_segments(f"{name}/limit", limit, QUIET, thickness=0.004)
            self._arcs.append(self._scene.add_line_segments(f"{name}/torque", limit, ESTIMATE, thickness=0.014))
        if arm.hand_m is not None:
            sphere = trimesh.creation.icosphere(subdivisions=3)
            self._ball = self._scene.add_mesh_simple(
                f"/arm/{arm.joints[-1]}/held", sphere.vertices, sphere.faces, color=STEEL,
                position=(0.0, 0.0, arm.hand_m), visible=False,
            )  # fmt: skip
            self._make_grabbable(self._ball, len(arm.joints) - 1, grab)
        self._held_kg = 0.0
        park = self._stand()
        self._true = Arrow(self._scene, "/push/true", TRUE, 0.009, park)
        self._estimate = Arrow(self._scene, "/push/estimate", ESTIMATE, 0.007, park)
        self._spring = Rod(self._scene, "/push/spring", SPRING, 0.002, park)
        self._places = PlaceDrawing(self._scene, arm.joints, park)
        letters = "".join(sorted(set("contact: collision, N estimated 0123456789-%" + "".join(arm.joints))))
        self._scene.add_label("/words/letters", letters, position=park, font_screen_scale=0.01)  # see arrow.NOTHING
        self._verdict, self._force = Label(self._scene, "/words/verdict", 1.5), Label(self._scene, "/words/force", 1.1)

    def show(self, snapshot: Snapshot) -> None:
        """Draw the snapshot."""
        for frame, pose in zip(self._frames, snapshot.poses, strict=True):
            frame.position, frame.wxyz = pose[:3], pose[3:]
        verdict = snapshot.verdicts.get(snapshot.method)
        alarmed = verdict.joint if verdict and verdict.alarm in TOUCHED else -1
        for j, part in enumerate(self._parts):
            level = verdict.alarm if verdict and j == alarmed else ""
            if level != self._levels[j]:
                self._levels[j] = level
                part.color = TOUCHED.get(level, PART)
        shares = np.nan_to_num(snapshot.tau_ext / snapshot.limit_nm).clip(-1.25, 1.25)
        for j, share in enumerate(np.round(shares * ARC_STEPS) / ARC_STEPS):
            if share == self._shares[j]:
                continue
            self._shares[j] = share
            self._arcs[j].points = arc(self._arm, j, np.linspace(0.0, share * ARC_RAD, ARC_POINTS))
            self._arcs[j].colors = np.array(TOUCHED["collision"] if abs(share) > 1 else ESTIMATE, np.uint8)
        self._show_held(0.0 if snapshot.held is None else snapshot.held.mass_kg)
        self._say_verdict(snapshot, alarmed)
        self._show_push(snapshot.touch, bool(snapshot.places_refused))
        self._places.show(snapshot.placed)

    def simplify(self, simple: bool) -> None:
        """Without floor and shadows, which cost a browser without a GPU nine tenths of its time."""
        self._floor.visible = not simple
        self._key.cast_shadow = not simple

    def _show_held(self, mass_kg: float) -> None:
        if mass_kg == self._held_kg:
            return
        self._held_kg, self._ball.visible = mass_kg, mass_kg > 0
        if mass_kg > 0:
            self._ball.scale = ball_radius_m(mass_kg)

    def _say_verdict(self, snapshot: Snapshot, joint: int) -> None:
        if joint < 0:
            self._verdict.show("")
        else:
            words = f"{snapshot.verdicts[snapshot.method].alarm}: {self._arm.joints[joint]}"
            self._verdict.show(words, snapshot.poses[joint, :3] + [0.0, 0.0, 0.16])

    def _show_push(self, touch: Touch | None, estimated: bool) -> None:
        """estimated: the method gives no places; its force is drawn at the point that the demo pushes."""
        if touch is None:
            for arrow in (self._true, self._estimate, self._spring):
                arrow.hide()
            self._force.show("")
            return
        at = touch.point_m
        self._true.show(at, at + NEWTON_M * touch.force_n)
        self._spring.show(at, touch.target_m)
        text = f"{np.linalg.norm(touch.force_n):.0f} N"
        if estimated:
            lifted = at + [0.0, 0.0, 0.022]
            self._estimate.show(lifted, lifted + NEWTON_M * touch.estimate_n)
            text += f", estimated {np.linalg.norm(touch.estimate_n):.0f} N"
        else:
            self._estimate.hide()
        self._force.show(text, at + [0.0, 0.0, 0.07])

    def _make_grabbable(self, handle: viser.MeshHandle, joint: int, grab: Grab) -> None:
        @handle.on_drag("left")
        async def _(event: viser.SceneNodeDragEvent) -> None:  # async: the phases stay in order
            where = event.start_position if event.phase == "start" else event.end_position
            grab(event.phase, event.client_id, joint, where)

    def _light(self, server: viser.ViserServer) -> None:
        scene, arm = server.scene, self._arm
        scene.set_up_direction("+z")
        scene.configure_environment_map(hdri=None)
        scene.configure_default_lights(enabled=False)
        scene.add_light_hemisphere("/light/sky", sky_color=(255, 255, 255), ground_color=(170, 165, 160), intensity=2.2)
        self._key = scene.add_light_directional(
            "/light/key", color=(255, 250, 240), intensity=2.4, position=(1.5, 2.0, 3.0), cast_shadow=True
        )
        scene.add_light_directional("/light/fill", color=(225, 235, 255), intensity=0.8, position=(-2.0, 1.0, 1.5))
        self._floor = scene.add_grid(
            "/floor",
            8.0,
            8.0,
            cell_size=0.1,
            section_size=0.5,
            cell_color=(226, 229, 233),
            section_color=(200, 205, 212),
            plane_color=(246, 247, 249),
            plane_opacity=1.0,
            shadow_opacity=0.2,
            fade_distance=9.0,
            fade_from="origin",
            position=(0.0, 0.0, arm.floor_m),
        )
        camera = server.initial_camera
        camera.position, camera.look_at, camera.fov = arm.camera_m, arm.look_at_m, np.deg2rad(45.0)

    def _stand(self) -> tuple[float, float, float]:
        """What carries the arm: a post behind the rig, whose arm turns all the way round, a foot under the others.

        Returns:
            A point inside it.
        """
        floor = self._arm.floor_m
        if floor < 0:
            post = trimesh.creation.box((0.12, 0.08, 0.1 - floor))
            post.apply_translation((0.0, -0.17, 0.5 * floor + 0.05))
            foot = trimesh.creation.box((0.45, 0.4, 0.03))
            foot.apply_translation((0.0, -0.17, floor + 0.015))
        else:
            post = trimesh.creation.cylinder(0.07, 0.12, sections=48)
            post.apply_translation((0.0, 0.0, 0.07))
            foot = trimesh.creation.cylinder(0.13, 0.02, sections=64)
            foot.apply_translation((0.0, 0.0, 0.01))
        mesh = trimesh.util.concatenate([post, foot])
        self._scene.add_mesh_simple("/stand", mesh.vertices, mesh.faces, color=DRUM, flat_shading=True)
        return tuple(post.bounds.mean(axis=0))


def shape_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """Triangles of one of MuJoCo's capsules, cylinders or boxes, in the frame of its body."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=[24, 24])
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=48)
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        mesh = trimesh.creation.box(2 * size)
    else:
        raise AssertionError(f"geom {geom} is of kind {kind}")
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    pose = np.eye(4)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
    return mesh.apply_transform(pose)


def arc(arm: DemoArm, joint: int, angles_rad: np.ndarray) -> np.ndarray:
    """Line segments (points - 1, 2, 3) of an arc about a joint's axis in its link's frame, around its drum."""
    model = arm.model
    axis = model.jnt_axis[joint]
    across = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.5 else [1.0, 0.0, 0.0])
    drums = (model.geom_bodyid == joint + 1) & (model.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER)
    centre = model.geom_pos[np.flatnonzero(drums)[0]]
    other = np.cross(axis, across)
    points = centre + ARC_RADIUS_M * (np.cos(angles_rad)[:, None] * other + np.sin(angles_rad)[:, None] * across)
    return np.stack([points[:-1], points[1:]], axis=1)
