"""What ties joints together so that a tree of independent joints no longer describes the arm."""

import mujoco

from tauext.errors import RobotError
from tauext.robot.tree_from_mujoco import carriers


def check_constraints(model: mujoco.MjModel, joint_ids: list[int], where: str) -> None:
    """Refuse mimic joints in use, closed loops between moving links, and rotor inertia that acts through a tendon.

    Raises:
        RobotError: names the joints, bodies or tendon, and what to do.
    """
    carrier = carriers(model, joint_ids)
    for k in range(model.neq):
        if not model.eq_active0[k]:
            continue
        if model.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT:
            _check_mimic(model, k, joint_ids, where)
        elif model.eq_type[k] == mujoco.mjtEq.mjEQ_CONNECT or model.eq_type[k] == mujoco.mjtEq.mjEQ_WELD:
            _check_loop(model, k, carrier, where)
    for tendon in range(model.ntendon):
        _check_tendon(model, tendon, joint_ids, carrier, where)


def _check_mimic(model: mujoco.MjModel, k: int, joint_ids: list[int], where: str) -> None:
    follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
    if follower not in joint_ids:
        return
    name = model.joint(follower).name
    what = f"follows {model.joint(leader).name!r} (mimic)" if leader >= 0 else "is held by an equality"
    raise RobotError(
        f"{where}: joint {name!r} {what} and is not independent: lock it, with locked={{{name!r}: position}} "
        "or by leaving it out of `joints`"
    )


def _check_loop(model: mujoco.MjModel, k: int, carrier: list[int], where: str) -> None:
    ends = [int(model.eq_obj1id[k]), int(model.eq_obj2id[k])]
    if model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
        ends = [int(model.site_bodyid[site]) for site in ends]
    if carrier[ends[0]] != carrier[ends[1]]:
        names = " and ".join(repr(model.body(body).name) for body in ends)
        raise RobotError(f"{where}: bodies {names} close a kinematic loop; a tree has none: lock the joints in it")


def _check_tendon(model: mujoco.MjModel, tendon: int, joint_ids: list[int], carrier: list[int], where: str) -> None:
    by_tendon = model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    drives = by_tendon & (model.actuator_trnid[:, 0] == tendon)
    if model.tendon_armature[tendon] == 0 and not model.actuator_armature[drives].any():
        return
    first = model.tendon_adr[tendon]
    joints, links = set(), set()
    for wrap in range(first, first + model.tendon_num[tendon]):
        if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT:
            joints.add(int(model.wrap_objid[wrap]))
        elif model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_SITE:
            links.add(carrier[model.site_bodyid[model.wrap_objid[wrap]]])
    if joints & set(joint_ids) or len(links) > 1:
        name = model.tendon(tendon).name
        raise RobotError(
            f"{where}: tendon {name!r} has armature and moves joints in use; rotor inertia must stand at a joint"
        )
