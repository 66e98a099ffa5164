"""The Franka Emika Panda: published kinematics and masses, and inverse kinematics for many arms.

Frames follow Craig's convention: frame ``i`` lies at ``Rot_x(alpha) Trans_x(a) Trans_z(d)`` from
frame ``i - 1`` and turns about its own z axis. ``B`` in shapes: arms.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Colour = tuple[float, float, float, float]

JOINTS = 7
HALF_TURN = np.pi / 2

# Franka Control Interface documentation, "Denavit-Hartenberg parameters": a (m), d (m), alpha.
DH = np.array(
    [
        [0.0, 0.333, 0.0],
        [0.0, 0.0, -HALF_TURN],
        [0.0, 0.316, HALF_TURN],
        [0.0825, 0.0, HALF_TURN],
        [-0.0825, 0.384, -HALF_TURN],
        [0.0, 0.0, HALF_TURN],
        [0.088, 0.0, HALF_TURN],
    ]
)
FLANGE = 0.107
"""From frame 7 to the flange along z, m; the same table."""
TOOL = 0.1034
"""From the flange to the tip of the closed fingers, m: the Franka Hand's default frame."""
HAND_YAW = -np.pi / 4
"""Of the hand on the flange, rad."""

# "Limits for Panda" of the same documentation: rad and N m.
LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])

# Gaz, Cognetti, Oliva, Robuffo Giordano & De Luca (2019), "Dynamic identification of the Franka
# Emika Panda robot", the feasible parameters they retrieve: kg; centre of mass in the link's
# frame, m; inertia about it, xx yy zz xy xz yz, kg m^2.
MASSES = np.array([4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522])
CENTRES = np.array(
    [
        [0.003875, 0.002081, -0.1750],
        [-0.003141, -0.02872, 0.003495],
        [0.027518, 0.039252, -0.066502],
        [-0.05317, 0.104419, 0.027454],
        [-0.011953, 0.041065, -0.038437],
        [0.060149, -0.014117, -0.010517],
        [0.010517, -0.004252, 0.061597],
    ]
)
INERTIAS = np.array(
    [
        [0.70337, 0.70661, 0.0091170, -0.00013900, 0.0067720, 0.019169],
        [0.0079620, 0.028110, 0.025995, -0.0039250, 0.010254, 0.00070400],
        [0.037242, 0.036155, 0.010830, -0.0047610, -0.011396, -0.012805],
        [0.025853, 0.019552, 0.028323, 0.0077960, -0.0013320, 0.0086410],
        [0.035549, 0.029474, 0.0086270, -0.0021170, -0.0040370, 0.00022900],
        [0.0019640, 0.0043540, 0.0054330, 0.00010900, -0.0011580, 0.00034100],
        [0.012516, 0.010027, 0.0048150, -0.00042800, -0.0011960, -0.00074100],
    ]
)
# The Franka Hand's data sheet and its frame in the same documentation.
HAND_MASS, HAND_CENTRE, HAND_INERTIA = 0.73, (-0.01, 0.0, 0.03), (0.001, 0.0025, 0.0017)

HOME = np.array([0.0, -0.5, 0.0, -2.6, 0.0, 2.1, 0.785])
"""Joint angles that the arm's spare degree of freedom is pulled to, rad; the hand points down."""
DAMPING = 0.03
"""lambda of damped least squares: near a singularity the joints give way instead of racing."""
ITERATIONS = 4
PULL = 0.05
"""Part of the way to ``HOME`` that the spare degree of freedom goes at each iteration."""

KP = np.array([1500.0, 1500.0, 1200.0, 1200.0, 600.0, 600.0, 300.0])
KV = 0.6 * np.array([120.0, 120.0, 90.0, 90.0, 25.0, 25.0, 15.0])

# The hand points straight down, its x axis forward.
DOWN = np.diag([1.0, -1.0, -1.0])

_WHITE, _GREY, _DARK = (0.93, 0.93, 0.95, 1), (0.55, 0.57, 0.60, 1), (0.12, 0.12, 0.14, 1)
FINGER = (0.020, 0.022, 0.045)
"""Half sizes of the closed finger, m: a peg of 40 x 44 mm."""


def frames(joints: Floats, base: Floats) -> Floats:
    """Frames of the seven links and of the tool for ``joints[B, 7]``: ``[B, 8, 4, 4]``.

    Args:
        joints: angles, rad.
        base: position of the robot's base, m ``[3]``.
    """
    count = len(joints)
    result = np.empty((count, JOINTS + 1, 4, 4))
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, :3, 3] = base
    cosines, sines = np.cos(joints), np.sin(joints)
    for i, link in enumerate(_LINKS):
        pose = pose @ link
        # Turning about z mixes the first two columns.
        c, s = cosines[:, i, None], sines[:, i, None]
        x, y = pose[:, :, 0].copy(), pose[:, :, 1].copy()
        pose[:, :, 0], pose[:, :, 1] = c * x + s * y, c * y - s * x
        result[:, i] = pose
    result[:, JOINTS] = pose @ _TOOL
    return result


def tool_positions(joints: Floats, base: Floats) -> Floats:
    """Positions of the fingertip for ``joints[B, 7]``, m: ``[B, 3]``."""
    return frames(joints, base)[:, JOINTS, :3, 3]


def inverse_kinematics(
    joints: Floats, targets: Floats, base: Floats, iterations: int = ITERATIONS
) -> Floats:
    """Joint angles ``[B, 7]`` that bring the fingertip to ``targets[B, 3]``, pointing down.

    Damped least squares (Nakamura & Hanafusa 1986; Wampler 1986) from ``joints[B, 7]``; the spare
    degree of freedom goes towards ``HOME``. The result is within the joint limits.

    Args:
        joints: angles to begin with, rad.
        targets: positions, m.
        base: position of the robot's base, m ``[3]``.
        iterations: of the method, at least 1.
    """
    joints = joints.copy()
    identity = np.eye(JOINTS)
    error = np.empty((len(joints), 6))
    jacobian = np.empty((len(joints), 6, JOINTS))
    for iteration in range(iterations):
        poses = frames(joints, base)
        tip, turn = poses[:, JOINTS, :3, 3], poses[:, JOINTS, :3, :3]
        axes, origins = poses[:, :JOINTS, :3, 2], poses[:, :JOINTS, :3, 3]
        error[:, :3] = targets - tip
        # Half the sum of the cross products of the axes: the rotation vector, for small angles.
        x, y, z = (_cross(turn[:, :, axis], DOWN[:, axis]) for axis in range(3))
        error[:, 3:] = 0.5 * (x + y + z)
        jacobian[:, :3] = _cross(axes, tip[:, None] - origins).transpose(0, 2, 1)
        jacobian[:, 3:] = axes.transpose(0, 2, 1)
        transposed = jacobian.transpose(0, 2, 1)
        damped = jacobian @ transposed + DAMPING**2 * np.eye(6)
        inverse = transposed @ np.linalg.inv(damped)
        spare = identity - inverse @ jacobian
        # With damping the pull is felt at the fingertip a little; the last iteration is for the
        # fingertip alone, or the arm would creep under zero action.
        pull = PULL * (HOME - joints) * (iteration + 1 < iterations)
        change = inverse @ error[:, :, None] + spare @ pull[:, :, None]
        joints = np.clip(joints + change[:, :, 0], LOWER, UPPER)
    return joints


def add_to(spec: mujoco.MjSpec, base: Floats) -> None:
    """Add the arm, its finger and seven position actuators to a scene.

    The links are drawn thin and do not collide; hand and finger do (``conaffinity`` 5: with
    everything of ``contype`` 1 or 4, see :mod:`hvf.envs.desk.scene`).
    """
    body = spec.worldbody.add_body(name="panda_base", pos=list(base))
    _draw(body, [0, 0, -0.02], [0, 0, 0.14], 0.045, _GREY)
    drawings: dict[int, tuple[list[float], list[float], float, Colour]] = {
        0: ([0, 0, -0.19], [0, 0, 0.0], 0.034, _WHITE),
        1: ([0, 0, 0], [0, -0.21, 0], 0.026, _WHITE),
        2: ([0, 0, -0.106], [0, 0, 0], 0.024, _GREY),
        3: ([0, 0, 0], [-0.0825, 0.10, 0], 0.021, _WHITE),
        4: ([0, 0, -0.284], [0, 0, 0], 0.017, _WHITE),
        5: ([0, 0, 0], [0.088, 0, 0], 0.019, _GREY),
        6: ([0, 0, 0], [0, 0, FLANGE], 0.018, _WHITE),
    }
    for i, (a, d, alpha) in enumerate(DH):
        body = body.add_body(
            name=f"panda_link{i + 1}",
            pos=[a, -np.sin(alpha) * d, np.cos(alpha) * d],
            quat=[np.cos(alpha / 2), np.sin(alpha / 2), 0, 0],
            mass=MASSES[i],
            ipos=CENTRES[i],
            fullinertia=INERTIAS[i],
            explicitinertial=True,
            gravcomp=1,
        )
        body.add_joint(
            name=f"panda_joint{i + 1}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0, 0, 1],
            range=[LOWER[i], UPPER[i]],
            limited=True,
            # Rotor inertia and friction are not published; these keep the joints well damped.
            armature=0.1,
            damping=[1.0, 0, 0],
        )
        _draw(body, *drawings[i])
        actuator = spec.add_actuator(
            name=f"panda_joint{i + 1}",
            target=f"panda_joint{i + 1}",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcerange=[-TORQUE[i], TORQUE[i]],
            forcelimited=True,
        )
        actuator.set_to_position(kp=KP[i], kv=KV[i])
    hand = body.add_body(
        name="hand",
        pos=[0, 0, FLANGE],
        quat=[np.cos(HAND_YAW / 2), 0, 0, np.sin(HAND_YAW / 2)],
        mass=HAND_MASS,
        ipos=HAND_CENTRE,
        inertia=HAND_INERTIA,
        explicitinertial=True,
        gravcomp=1,
    )
    touching = {"contype": 0, "conaffinity": 5, "friction": [0.6, 0.005, 0.0001]}
    hand.add_geom(
        name="hand",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.024, 0.034, 0.012],
        pos=[0, 0, TOOL - 2 * FINGER[2] - 0.002],
        rgba=_GREY,
        **touching,
    )
    hand.add_geom(
        name="finger",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=FINGER,
        pos=[0, 0, TOOL - FINGER[2]],
        rgba=_DARK,
        **touching,
    )


def _draw(
    body: mujoco.MjsBody, begin: list[float], end: list[float], radius: float, colour: Colour
) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[*begin, *end],
        size=[radius, 0, 0],
        rgba=colour,
        contype=0,
        conaffinity=0,
        mass=0,
    )


def _cross(left: Floats, right: Floats) -> Floats:
    """Cross products over the last axis; numpy's own is several times slower on so few."""
    (a, b, c), (x, y, z) = np.moveaxis(left, -1, 0), np.moveaxis(right, -1, 0)
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)


def _transform(a: float, d: float, alpha: float, yaw: float = 0.0) -> Floats:
    c, s = np.cos(alpha), np.sin(alpha)
    along_x = np.array([[1, 0, 0, a], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])
    c, s = np.cos(yaw), np.sin(yaw)
    along_z = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, d], [0, 0, 0, 1]])
    product: Floats = along_x @ along_z
    return product


_LINKS = [_transform(*row) for row in DH]
_TOOL = _transform(0.0, FLANGE + TOOL, 0.0, HAND_YAW)
