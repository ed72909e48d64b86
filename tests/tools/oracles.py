"""What the tests of the dynamics share: robots, the same robots as pinocchio models, and random states.

A `Case` holds a robot together with a pinocchio model that was not made from it: both read the same URDF file, or both
were built from the same random numbers. Only the shipped robots have a model made from the robot, since their tables
exist nowhere else; `pinocchio_model` does that. Poses are translated here by pinocchio's quaternions, not by torchdq.
"""

import dataclasses
import importlib.metadata
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import pinocchio as pin
import torch
from robots import ARMS
from rotations import flat, tensor

import torchdq
from torchdq.dynamics.general.posed import General
from torchdq.dynamics.joints import Coordinate

EPS = {torch.float64: 2.0**-52, torch.float32: 2.0**-23}

# --- poses and inertias ----------------------------------------------------------------------------------------------


def se3(x) -> pin.SE3:
    """Placement of a dual quaternion [8]: r + (eps/2) p r."""
    primary, dual = (pin.Quaternion(*map(float, part)) for part in (x[:4], x[4:]))
    return pin.SE3(primary.matrix(), 2 * (dual * primary.conjugate()).coeffs()[:3])


def dual_quaternion(placement: pin.SE3) -> np.ndarray:
    """Dual quaternion [8] of a placement."""
    r, p = pin.Quaternion(placement.rotation), pin.Quaternion(0.0, *placement.translation)
    (x, y, z, w), (dx, dy, dz, dw) = r.coeffs(), (p * r).coeffs()
    return np.array([w, x, y, z, dw / 2, dx / 2, dy / 2, dz / 2])


def moved_parameters(placement: pin.SE3) -> np.ndarray:
    """Matrix [10, 10] that takes inertial parameters about frame B to those about A, B being at the placement in A.

    By the 4 x 4 pseudo-inertia J = integral of (p, 1)(p, 1)^T dm, which moves as H J H^T.
    """
    columns = []
    for parameters in np.eye(10):
        m, h, inertia = parameters[0], parameters[1:4], tensor(parameters[4:])
        J = np.block([[inertia.trace() / 2 * np.eye(3) - inertia, h[:, None]], [h, np.array([m])]])
        J = placement.homogeneous @ J @ placement.homogeneous.T
        columns.append([J[3, 3], *J[:3, 3], *flat(J[:3, :3].trace() * np.eye(3) - J[:3, :3])])
    return np.array(columns).T


# --- a robot and its model -------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A robot and a pinocchio model of it, whose joints and frames are found by name."""

    robot: torchdq.Robot
    model: pin.Model
    root: ClassVar[int] = 0  # joints of the model that carry the base

    @property
    def joints(self) -> list[pin.JointModel]:
        """Pinocchio's joints in the order of the robot's."""
        # getJointId does not raise for a name it does not know
        if {*self.robot.joint_names} - {*self.model.names} or self.model.njoints - 1 - self.root != self.robot.n:
            raise LookupError(f"the model has the joints {[*self.model.names]}, the robot {self.robot.joint_names}")
        return [self.model.joints[self.model.getJointId(name)] for name in self.robot.joint_names]

    @property
    def order(self) -> list[int]:
        """Index of each of the robot's joints in pinocchio's velocities."""
        return [joint.idx_v for joint in self.joints]

    def configuration(self, q: Sequence[float]) -> np.ndarray:
        """Pinocchio's configuration of joint positions; an unbounded joint becomes its cosine and sine."""
        configuration = np.zeros(self.model.nq)
        for joint, value in zip(self.joints, q, strict=True):
            numbers = [value] if joint.nq == 1 else [math.cos(value), math.sin(value)]
            configuration[joint.idx_q : joint.idx_q + joint.nq] = numbers
        return configuration

    def velocity(self, qd: Sequence[float]) -> np.ndarray:
        """Joint velocities, accelerations or torques in pinocchio's order."""
        velocity = np.zeros(self.model.nv)
        velocity[self.order] = np.asarray(qd)
        return velocity

    def frame_id(self, name: str) -> int:
        """Pinocchio's index of a link's frame; a joint may have the same name as a link."""
        if not self.model.existFrame(name, pin.FrameType.BODY):
            raise LookupError(f"the model has no link frame {name!r}")
        return self.model.getFrameId(name, pin.FrameType.BODY)

    def link_placements(self) -> list[pin.SE3]:
        """Placement of every link frame in pinocchio's frame of its joint."""
        return [self.model.frames[self.frame_id(name)].placement for name in self.robot.link_names]

    def wrenches(self, f_ext) -> list[pin.Force]:
        """Wrenches [n, 6] on the links, in link frames, as pinocchio's list over its own joint frames."""
        forces = [pin.Force.Zero() for _ in range(self.model.njoints)]
        for joint, placement, f in zip(self.joints, self.link_placements(), f_ext, strict=True):
            forces[joint.id] = placement.act(pin.Force(np.array(f[:3]), np.array(f[3:])))
        return forces

    def with_gravity(self, gravity) -> "Case":
        """Case with another gravity, in the base frame."""
        model = pin.Model(self.model)
        model.gravity.linear = np.array(gravity)
        robot = self.robot.replace(gravity=torch.tensor(gravity, dtype=torch.float64))
        return Case(robot, model)


class Piece(NamedTuple):
    """A joint and its link for `assemble`."""

    parent: int
    kind: str
    axis: np.ndarray  # in the joint frame
    pitch: float  # [m/rad]
    home: float
    joint_in_parent: pin.SE3  # joint frame in the parent's joint frame at home; its origin is on the axis
    link_in_joint: pin.SE3
    mass: float
    com: np.ndarray  # in the link frame
    inertia: np.ndarray  # about the centre of mass, in link axes


Names = Sequence[str]


def assemble(pieces: Sequence[Piece], joints: Names, links: Names, gravity, armature, tip) -> pin.Model:
    """Pinocchio model of named joints and links; `tip` is a frame's name, its link, and its placement there."""
    model = pin.Model()
    model.gravity.linear = np.asarray(gravity, dtype=float)
    index = {-1: 0}  # pinocchio's joint of each link; the universe is joint 0
    for i in depth_first([piece.parent for piece in pieces]):
        piece = pieces[i]
        # pinocchio's joints are at zero where its placements are, so take the motion to home back
        turn = pin.exp3(-piece.home * piece.axis)
        if piece.kind == "revolute":
            joint, back = pin.JointModelRevoluteUnaligned(piece.axis), pin.SE3(turn, np.zeros(3))
        elif piece.kind == "prismatic":
            joint, back = pin.JointModelPrismaticUnaligned(piece.axis), pin.SE3(np.eye(3), -piece.home * piece.axis)
        else:
            joint = pin.JointModelHelicalUnaligned(piece.axis, piece.pitch)
            back = pin.SE3(turn, -piece.home * piece.pitch * piece.axis)
        index[i] = model.addJoint(index[piece.parent], joint, piece.joint_in_parent * back, joints[i])
        model.appendBodyToJoint(index[i], pin.Inertia(piece.mass, piece.com, piece.inertia), piece.link_in_joint)
        model.addBodyFrame(links[i], index[i], piece.link_in_joint, 0)
    name, link, in_link = tip
    model.addBodyFrame(name, index[link], pieces[link].link_in_joint * in_link, 0)
    model.addBodyFrame("base", 0, pin.SE3.Identity(), 0)
    if armature is not None:
        by_joint = np.zeros(model.nv)
        for i, value in enumerate(armature):
            by_joint[model.joints[index[i]].idx_v] = value
        model.armature = by_joint
    return model


def depth_first(parents: Sequence[int]) -> list[int]:
    """Links in an order that leaves no subtree before it is complete, which pinocchio's mass matrix relies on."""
    order, stack = [], [i for i, parent in enumerate(parents) if parent < 0]
    while stack:
        order.append(stack.pop())
        stack += [i for i, parent in enumerate(parents) if parent == order[-1]]
    return order


def pinocchio_model(robot: torchdq.Robot) -> pin.Model:
    """Pinocchio model of a robot without batch axes: same joints, by name, and same numbers."""
    pieces: list[Piece] = []
    for i in range(robot.n):
        direction, moment = robot.screw[i, :3].numpy(), robot.screw[i, 3:].numpy()
        if robot.kinds[i] == "prismatic":
            axis, point, pitch = moment, np.zeros(3), 0.0
        else:
            axis, point, pitch = direction, np.cross(direction, moment), float(direction @ moment)
        joint_in_link = pin.SE3(np.eye(3), point)
        parent = robot.parents[i]
        link_in_parent_link = se3(robot.X_PB_home[i])
        parent_link = pin.SE3.Identity() if parent < 0 else pieces[parent].link_in_joint
        moving = parent, robot.kinds[i], axis, pitch, 0.0 if robot.home is None else float(robot.home[i])
        placed = parent_link * link_in_parent_link * joint_in_link, joint_in_link.inverse()
        body = float(robot.mass[i]), robot.com[i].numpy(), tensor(robot.inertia[i].tolist())
        pieces.append(Piece(*moving, *placed, *body))
    gravity = np.zeros(3) if robot.gravity is None else robot.gravity.numpy()
    tip = robot.frame(robot.tip)
    own_tip = (tip.name, tip.link, se3(tip.X_BF))
    return assemble(pieces, robot.joint_names, robot.link_names, gravity, robot.armature, own_tip)


# --- random trees ----------------------------------------------------------------------------------------------------

TREES = 200


def random_inertia(rng: np.random.Generator, mass: float) -> np.ndarray:
    """Inertia [3, 3] of a mass with random second moments along random axes."""
    spread = mass * rng.uniform(0.02, 0.2, 3) ** 2  # integral of x^2, y^2, z^2 dm
    R = pin.exp3(rng.normal(size=3) * 2)
    inertia = R @ np.diag(spread.sum() - spread) @ R.T
    return (inertia + inertia.T) / 2


def random_placement(rng: np.random.Generator, distance: float) -> pin.SE3:
    """Placement with any rotation and a random offset [m]."""
    return pin.SE3(pin.exp3(rng.normal(size=3) * 2), rng.normal(size=3) * distance)


def random_tree(n: int, seed: int, armature: bool = False) -> Case:
    """Tree of n joints of all kinds with nothing aligned, as a robot and as a pinocchio model of the same numbers.

    Joint axes pass beside the link frames, centres of mass beside both; inertia tensors are full, home positions and
    gravity are random. Pinocchio's joint frames lie elsewhere on the axes and are turned at random, so that the two
    share no frame but the base.
    """
    rng = np.random.default_rng([20261121, n, seed])
    parents = [i - 1 if rng.random() < 0.6 else int(rng.integers(-1, i)) for i in range(n)]
    kinds = [str(rng.choice(["revolute", "prismatic", "helical"], p=[0.6, 0.2, 0.2])) for _ in range(n)]
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    pitches = rng.uniform(-0.3, 0.3, n)
    home = rng.uniform(-1.0, 1.0, n)
    mass = rng.uniform(0.2, 4.0, n)
    com = rng.normal(size=(n, 3)) * 0.1
    inertia = np.stack([random_inertia(rng, m) for m in mass])
    gravity = rng.normal(size=3) * 6
    rotors = rng.uniform(0.01, 0.5, n) if armature else None

    # everything at home, in the base frame
    links: list[pin.SE3] = []
    for parent in parents:
        at = np.zeros(3) if parent < 0 else links[parent].translation
        placement = random_placement(rng, 0.25)
        links.append(pin.SE3(placement.rotation, at + placement.translation))
    points = np.array([link.translation + rng.normal(size=3) * 0.1 for link in links])  # one on every axis
    tip = pin.SE3(random_placement(rng, 0).rotation, links[-1].translation + rng.normal(size=3) * 0.2)
    turned = [pin.SE3(random_placement(rng, 0).rotation, point) for point in points]  # pinocchio's joint frames

    screws = []
    for kind, axis, point, pitch in zip(kinds, axes, points, pitches, strict=True):
        moment = np.cross(point, axis) + (pitch * axis if kind == "helical" else 0.0)
        screws.append(np.concatenate([np.zeros(3), axis] if kind == "prismatic" else [axis, moment]))
    joint_names, link_names = [f"j{i}" for i in range(n)], [f"b{i}" for i in range(n)]
    robot = torchdq.Robot.from_screws(
        np.array(screws),
        mass,
        com,
        inertia,
        link_poses=np.array([dual_quaternion(link) for link in links]),
        tip_pose=dual_quaternion(tip),
        parents=parents,
        home=home,
        joint_names=joint_names,
        link_names=link_names,
        gravity=gravity,
        name=f"tree{seed}",
    )
    if rotors is not None:
        robot = robot.replace(armature=torch.from_numpy(rotors))

    pieces = []
    for i, parent in enumerate(parents):
        moving = parent, kinds[i], turned[i].rotation.T @ axes[i], float(pitches[i]), float(home[i])
        in_parent = turned[i] if parent < 0 else turned[parent].inverse() * turned[i]
        pieces.append(Piece(*moving, in_parent, turned[i].inverse() * links[i], float(mass[i]), com[i], inertia[i]))
    tip_on_link = ("tip", n - 1, links[-1].inverse() * tip)
    return Case(robot, assemble(pieces, joint_names, link_names, gravity, rotors, tip_on_link))


# --- robots of example-robot-data ------------------------------------------------------------------------------------

UNREADABLE = {"ur3": "exactly one link must be the base, carried by no joint, found 0"}  # an empty <robot>

JOINTLESS = ("quadrotor_base", "iris_simple")  # flying bodies: nothing moves when the base is fixed

# what the loader warns of unless it is told to ignore what is unphysical
ODD = {
    "alex_psyonic_hands": "'LeftPsyonicAbilityBaseLink': the largest principal moment",
    "allegro_left_hand": "'link_11.0': the largest principal moment",
    "allegro_right_hand": "'link_3.0': the largest principal moment",
    "hyq_no_sensors": "'lf_foot': the largest principal moment",
    "pr2": "'sensor_mount_link': the largest principal moment",
    "romeo_small": "'RShoulderYawLink': the largest principal moment",
}
# what it refuses
UNPHYSICAL = {"romeo_laas_small": "'LHipPitch_link': inertia must be positive definite"}

SINGULAR = ("romeo", "romeo_laas_small")  # fingers without mass: accelerations are undefined

BEYOND_RIGID_BODIES = {"link": ("visual", "collision"), "joint": ("limit", "dynamics", "mimic")}  # for MuJoCo


@cache
def urdf_paths() -> dict[str, Path]:
    """Every URDF file of example-robot-data by a short unique name."""
    files = importlib.metadata.files("example-robot-data") or []
    paths = [Path(str(file.locate())) for file in files if file.name.endswith(".urdf")]
    stems = [path.stem for path in paths]

    def name(path: Path) -> str:
        folder = path.parts[path.parts.index("robots") + 1].removesuffix("_description")
        return path.stem if stems.count(path.stem) == 1 else f"{folder}-{path.stem}"

    return {name(path): path for path in sorted(paths)}


def example_robots() -> dict[str, Path]:
    """URDF files of example-robot-data that are robots on a fixed base: all that can be read and have a joint."""
    return {name: path for name, path in urdf_paths().items() if name not in (*UNREADABLE, *JOINTLESS)}


@cache
def example_case(name: str) -> Case:
    """A robot of example-robot-data and pinocchio's own reading of its file, a tip chosen where the file has several.

    Unphysical robots are read too: their dynamics are as well defined as anyone's. Joints that mimic others are
    independent, as pinocchio has them.
    """
    path = urdf_paths()[name]
    robot = torchdq.Robot.from_urdf(path, on_unphysical="ignore", mimic="independent")
    if robot.tip is None:
        robot = robot.with_tip([frame.name for frame in robot.frames if frame.link >= 0][-1])
    return Case(robot, pin.buildModelFromUrdf(str(path)))


def rigid_bodies(name: str) -> str:
    """Text of a robot's file with rigid bodies alone, for MuJoCo, whose compiler is told to keep links as they are."""
    root = ET.fromstring(urdf_paths()[name].read_text(encoding="utf-8-sig"))
    for tag, unwanted in BEYOND_RIGID_BODIES.items():
        for parent in root.findall(tag):
            for element in [child for child in parent if child.tag in unwanted]:
                parent.remove(element)
    settings = {"fusestatic": "false", "discardvisual": "false", "balanceinertia": "false"}
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", settings)
    return ET.tostring(root, encoding="unicode")


# --- all cases -------------------------------------------------------------------------------------------------------


def shipped(name: str) -> Case:
    """A shipped robot and a model made from it."""
    robot = torchdq.robots.load(name)
    return Case(robot, pinocchio_model(robot))


def tree(seed: int) -> Case:
    """Random tree of 1 to 12 joints, some with more; every second has rotors, every third its tip on an inner link."""
    n = 13 + seed // 10 if seed % 25 == 24 else 1 + seed % 12
    built = random_tree(n, seed, armature=seed % 2 == 1)
    return Case(built.robot.with_tip(f"b{n // 2}"), built.model) if seed % 3 == 0 else built


TREE_NAMES = tuple(f"tree{seed}" for seed in range(TREES))
SHIPPED_NAMES = tuple(f"shipped-{name}" for name in ARMS)

# a robot of every folder: chains and trees, hinges, slides and unbounded joints, with and without mass, few joints and
# many; and random trees of every size, with and without rotors, one of them large
REPRESENTATIVE_ROBOTS = (
    *("a1", "alex_nub_hands", "alexander_v1.lowerBodyOnly", "allegro_right_hand", "anymal-kinova", "TwoDofs", "b1-z1"),
    *("anymal_b_simple-anymal", "anymal_c_simple-anymal", "baxter", "bolt", "borinot_flying_arm_2", "centauro"),
    *("double_pendulum_continuous", "finger_edu", "g1_29dof_rev_1_0", "go1", "go2", "hextilt_flying_arm_5", "human"),
    *("hyq_no_sensors", "icub_reduced", "iris", "kinova", "laikago", "panda", "pr2", "quadruped", "romeo_small"),
    *("simple_humanoid_classical", "so101", "solo12", "talos_left_arm", "tiago_no_hand", "tiago_pro", "ur10_robot"),
    *("xarm7", "z1"),
)
REPRESENTATIVE_TREES = (*TREE_NAMES[::22], "tree55", "tree121", "tree124")
REPRESENTATIVES = (*REPRESENTATIVE_ROBOTS, *SHIPPED_NAMES, *REPRESENTATIVE_TREES)


@cache
def case(name: str) -> Case:
    """Case of a name in `names()`."""
    if name in TREE_NAMES:
        return tree(int(name.removeprefix("tree")))
    if name in SHIPPED_NAMES:
        return shipped(name.removeprefix("shipped-"))
    return example_case(name)


def names() -> tuple[str, ...]:
    """Names of all cases."""
    return (*example_robots(), *SHIPPED_NAMES, *TREE_NAMES)


# --- states ----------------------------------------------------------------------------------------------------------


class States(NamedTuple):
    """Random states of a robot, [batch, ...]."""

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    f_tip: torch.Tensor
    f_ext: torch.Tensor

    def rows(self):
        """The states one by one, as float64 arrays."""
        return zip(*(x.double().numpy() for x in self), strict=True)


@cache
def states(robot: torchdq.Robot, batch: int = 3, seed: int = 0, dtype: torch.dtype = torch.float64) -> States:
    """Random positions (several turns of what turns), velocities, accelerations and wrenches, none of them zero."""
    rng = np.random.default_rng([robot.n, seed])
    slides = np.array([not joint.turns for joint in robot.joint_types], dtype=bool)
    joint, sizes = (robot.n,), (np.where(slides, 0.3, 3.0), 2, 5, 10, 10)
    shapes = (joint, joint, joint, (6,), (robot.n, 6))
    arrays = (rng.normal(size=(batch, *shape)) * size for shape, size in zip(shapes, sizes, strict=True))
    return States(*(torch.from_numpy(x).to(dtype) for x in arrays))


# --- pinocchio's answers, and sizes to measure errors by -------------------------------------------------------------


def over(function, case: Case, s: States) -> np.ndarray:
    """Results of function(model, data, q, qd, qdd, f_tip, f_ext) for each state, inputs in pinocchio's order."""
    data = case.model.createData()
    return np.array(
        [
            function(case.model, data, case.configuration(q), case.velocity(qd), case.velocity(qdd), f_tip, f_ext)
            for q, qd, qdd, f_tip, f_ext in s.rows()
        ]
    )


def size_of_torques(case: Case, s: States) -> np.ndarray:
    """Size of what makes up each joint's torque, the largest over the states.

    The sum of the magnitudes of its terms |Y| |pi|, the wrench in the joint, and the rates w x G(V) at which the
    momenta beyond it turn: a torque that vanishes by symmetry is still a rounded sum of numbers of that size.
    """
    bodies = list(case.model.inertias)[1:]
    parameters = np.abs(np.concatenate([body.toDynamicParameters() for body in bodies]))
    turns, slides = np.array([kind != "prismatic" for kind in case.robot.kinds]), pitches(case)

    def size(model, data, q, v, a, *_):
        terms = np.abs(pin.computeJointTorqueRegressor(model, data, q, v, a)) @ parameters + model.armature * np.abs(a)
        pin.rnea(model, data, q, v, a)
        moments, forces = np.zeros(model.njoints), np.zeros(model.njoints)
        for i in reversed(range(1, model.njoints)):
            moments[i] += model.inertias[i].vtiv(data.v[i])
            forces[i] += np.linalg.norm(data.v[i].angular) * np.linalg.norm((model.inertias[i] * data.v[i]).linear)
            moments[model.parents[i]] += moments[i]
            forces[model.parents[i]] += forces[i]
            moments[i] += np.linalg.norm(data.f[i].angular)
            forces[i] += np.linalg.norm(data.f[i].linear)
        ids = [joint.id for joint in case.joints]
        return terms[case.order] + turns * moments[ids] + slides * forces[ids]

    return over(size, case, s).max(0)


def pitches(case: Case) -> np.ndarray:
    """Motion along the axis per unit of each joint's coordinate."""
    rows = zip(case.robot.kinds, case.robot.screw.numpy(), strict=True)
    return np.array([1.0 if kind == "prismatic" else abs(s[:3] @ s[3:]) for kind, s in rows])


def worst(found, reference, size) -> float:
    """Largest |found - reference| / size, broadcast; 0 where both vanish; NaN or infinite if the difference is."""
    difference = np.abs(np.asarray(found, dtype=float) - np.asarray(reference, dtype=float))
    difference, size = np.broadcast_arrays(difference, np.asarray(size, dtype=float))
    ratio = np.divide(difference, size, out=np.where(difference == 0, 0.0, np.inf), where=size != 0)
    return float("nan") if np.isnan(difference).any() else float(ratio.max(initial=0.0))


def scaled(M: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mass matrices scaled to a unit diagonal, and the scale D = diag(M)^-1/2."""
    D = M.double().diagonal(dim1=-2, dim2=-1).rsqrt()
    return D[..., None] * M.double() * D[..., None, :], D


def scaled_condition(M: torch.Tensor) -> float:
    """Largest condition number of mass matrices scaled to a unit diagonal: accelerations are as good as it is small."""
    return float(torch.linalg.cond(scaled(M)[0]).max())


# --- the paper's form on tensors -------------------------------------------------------------------------------------


def as_printed(robot: torchdq.Robot, q: torch.Tensor) -> General:
    """The robot at positions [..., n] in the paper's form, its numbers tensors [...]."""
    x = q if robot.home is None else q - robot.home
    coordinates = [None, *(Coordinate(v, (0.5 * v).cos(), (0.5 * v).sin()) for v in x.unbind(-1))]
    return General.at(robot.tree(), robot.com.unbind(-2), coordinates)


def stack(rows, batch: tuple[int, ...]) -> torch.Tensor:
    """Tensor [*batch, ...] of nested numbers, None being zero."""
    if isinstance(rows, list | tuple):
        return torch.stack([stack(row, batch) for row in rows], len(batch))
    return torch.as_tensor(0.0 if rows is None else rows, dtype=torch.float64).expand(batch)
