"""
Scripted experts for tasks of ManiSkill, as a source of demonstrations that needs no motion planner.

They know where things are, move the hand step by step in proportion to what is left, and go on holding what they have
reached. One is made when it is asked for its first action (``expert_action()`` of the environment), and forgotten when the
episode ends.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

#: Metres of motion that an action of 1 asks for.
REACH = 0.1
#: Radians of rotation; negative, because ManiSkill 3.0.1 scales rotations by their lower bound.
TURN = -0.1
OPEN, CLOSED = 1.0, -1.0
#: Controllers whose actions the experts give: translation, rotation where there is one, fingers.
CONTROLLERS = ("pd_ee_delta_pose", "pd_ee_delta_pos")
ROBOTS = ("panda", "panda_wristcam")
UP = np.array([0.0, 0.0, 1.0])
LEVEL = np.array([1.0, 1.0, 0.0])
"""Times a vector: its part along the table."""


class Expert:
    """
    :param task: the ManiSkill environment
    :param row: which of its parallel scenes
    """

    #: The controllers with which it can do the task.
    controllers: tuple[str, ...] = CONTROLLERS

    def __init__(self, task: Any, row: int):
        self.task = task
        self.row = row
        #: Whether the controller turns the hand.
        self.turns = task.single_action_space.shape[0] == 7

    def act(self) -> np.ndarray:
        """:return: the next action, in [-1, 1], shape ``(7,)`` or ``(4,)``"""
        raise NotImplementedError

    # ------------------------------------------------------------------ what it knows
    def position(self, thing: Any) -> np.ndarray:
        """:return: of an object or pose, metres, shape ``(3,)``"""
        return getattr(thing, "pose", thing).p[self.row].cpu().numpy().astype(np.float64)

    def rotation(self, thing: Any) -> np.ndarray:
        """:return: of an object, its axes as columns, shape ``(3, 3)``"""
        w, x, y, z = thing.pose.q[self.row].cpu().numpy()
        return Rotation.from_quat([x, y, z, w]).as_matrix()

    @property
    def hand(self) -> np.ndarray:
        """Between the fingertips, metres, shape ``(3,)``."""
        return self.position(self.task.agent.tcp)

    @property
    def closing_angle(self) -> float:
        """Of the line along which the fingers close, seen from above, radians."""
        line = self.rotation(self.task.agent.tcp)[:, 1]
        return float(np.arctan2(line[1], line[0]))

    # ------------------------------------------------------------------ what it does
    def action(self, move: np.ndarray, gripper: float, turn: np.ndarray | None = None) -> np.ndarray:
        """
        :param move: metres, world frame, shape ``(3,)``; farther than a step reaches, it keeps its direction
        :param gripper: :data:`OPEN` or :data:`CLOSED`
        :param turn: rotation vector, world frame, shape ``(3,)``; None for none. Left out where the controller cannot turn
        """
        base = self.rotation(self.task.agent.robot).T  # actions are in the frame of the robot
        parts = [np.clip(base @ move / REACH, -1, 1)]
        if self.turns:
            parts.append(np.zeros(3) if turn is None else _shortened(base @ turn / TURN))
        return np.concatenate([*parts, [gripper]]).astype(np.float32)

    def turn_to(self, rotation: np.ndarray) -> np.ndarray:
        """:return: rotation vector from the hand as it is to the one that is wanted, shape ``(3,)``"""
        return Rotation.from_matrix(rotation @ self.rotation(self.task.agent.tcp).T).as_rotvec()


def _shortened(vector: np.ndarray) -> np.ndarray:
    return vector / max(1.0, float(np.linalg.norm(vector)))


def _downward(angle: float) -> np.ndarray:
    """:return: rotation of a hand that points down and closes its fingers along the line at this angle, seen from above"""
    closing = np.array([np.cos(angle), np.sin(angle), 0.0])
    return np.stack([np.cross(closing, -UP), closing, -UP], axis=1)


def _as_line(angle: float) -> float:
    """:return: the same angle of a line, from -pi / 2 to pi / 2: it does not matter which finger is where"""
    return (angle + np.pi / 2) % np.pi - np.pi / 2


# ---------------------------------------------------------------------- grasps


class Grasp(Expert):
    """Above a thing, down, close, and carry it."""

    #: Metres above the grasp from where the hand goes down
    CLEARANCE = 0.08
    #: How near it has to be to close its fingers, metres; to go down, metres and radians
    NEAR, ALIGNED, TURNED = 0.012, 0.01, 0.1
    #: Steps that the fingers need to close
    CLOSING = 2
    #: Metres between hand and grasp from which on it has slipped out, and is grasped anew
    LOST = 0.05

    def __init__(self, task: Any, row: int):
        super().__init__(task, row)
        self.above, self.closing = False, 0
        self.placed = False  # let go on purpose

    def grip(self) -> np.ndarray:
        """:return: where the fingers take hold, metres"""
        raise NotImplementedError

    def grip_angle(self) -> float | None:
        """:return: along which line they close, seen from above; None: as they stand"""
        return None

    def carry(self) -> np.ndarray:
        """:return: the action with the thing in the hand"""
        raise NotImplementedError

    def turn(self) -> np.ndarray:
        """:return: what is left until the fingers close along that line"""
        angle = self.grip_angle()
        if angle is None or not self.turns:
            return np.zeros(3)
        now = self.closing_angle
        return self.turn_to(_downward(now + _as_line(angle - now)))

    def act(self) -> np.ndarray:
        way, turn = self.grip() - self.hand, self.turn()
        if self.closing >= self.CLOSING:
            if self.placed or np.linalg.norm(way) < self.LOST:
                return self.carry()
            self.above, self.closing = False, 0
        if self.above and np.linalg.norm(way) < self.NEAR:
            self.closing += 1
            return self.action(way, CLOSED, turn)
        if np.linalg.norm(turn) < self.TURNED and np.linalg.norm(way * LEVEL) < self.ALIGNED:
            self.above = True
        return self.action(way if self.above else way + self.CLEARANCE * UP, OPEN, turn)


class PickCube(Grasp):
    """To the goal. The fingers turn the cube as they close."""

    def grip(self) -> np.ndarray:
        return self.position(self.task.cube)

    def carry(self) -> np.ndarray:
        return self.action(self.position(self.task.goal_site) - self.grip(), CLOSED)


class LiftCube(PickCube):
    """A little higher than asked for."""

    def carry(self) -> np.ndarray:
        return self.action(self.position(self.task.goal_site) + 0.01 * UP - self.grip(), CLOSED)


class PickObject(Grasp):
    """Across where it is narrowest, seen from above."""

    #: Metres below the top of a thing, and at least above its bottom, where the fingers take hold
    DEPTH, FLOOR = 0.03, 0.012
    #: Metres of width that a radian of turning is worth
    PATIENCE = 0.01

    def __init__(self, task: Any, row: int):
        super().__init__(task, row)
        self._corners = np.asarray(task._objs[row].get_first_collision_mesh(to_world_frame=False).vertices)
        now, corners = self.closing_angle, self.corners()
        lines = now + (np.linspace(-np.pi / 2, np.pi / 2, 37) if self.turns else np.zeros(1))
        widths = np.array([np.ptp(corners[:, :2] @ [np.cos(line), np.sin(line)]) for line in lines])
        self._line = float(lines[np.argmin(widths + self.PATIENCE * np.abs(lines - now))])

    def corners(self) -> np.ndarray:
        """:return: of the object, metres, shape ``(n, 3)``"""
        return self._corners @ self.rotation(self.task.obj).T + self.position(self.task.obj)

    def grip(self) -> np.ndarray:
        corners = self.corners()
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle = (low + high) / 2
        return np.array([*middle[:2], max(middle[2], high[2] - self.DEPTH, low[2] + self.FLOOR)])

    def grip_angle(self) -> float:
        return self._line

    def carry(self) -> np.ndarray:
        placed = getattr(self.task, "obj_pose", self.task.obj)  # where the task measures it: EGAD's at their centre of mass
        return self.action(self.position(self.task.goal_site) - self.position(placed), CLOSED)


class StackCube(Grasp):
    """One cube onto the other, and let go."""

    #: Metres that the cube is carried above where it is put down
    LIFT = 0.03

    def __init__(self, task: Any, row: int):
        super().__init__(task, row)
        self.lifted = False
        self._line = self._free_line()

    def _free_line(self) -> float:
        """:return: across two faces of the cube, and not toward the other cube where no finger has room between them"""
        face = self.rotation(self.task.cubeA)[:, 0]
        other = (self.position(self.task.cubeB) - self.position(self.task.cubeA)) * LEVEL
        now = self.closing_angle
        lines = [now + _as_line(np.arctan2(face[1], face[0]) + quarter - now) for quarter in (0, np.pi / 2)]
        if np.linalg.norm(other) < 0.1:
            return min(lines, key=lambda line: abs(other @ [np.cos(line), np.sin(line), 0]))
        return min(lines, key=lambda line: abs(line - now))

    def grip(self) -> np.ndarray:
        return self.position(self.task.cubeA)

    def grip_angle(self) -> float:
        return self._line

    def way(self) -> np.ndarray:
        """:return: from the cube to its place, metres"""
        return self.position(self.task.cubeB) + 2 * self.task.cube_half_size[2].item() * UP - self.grip()

    def carry(self) -> np.ndarray:
        way = self.way()
        over = np.linalg.norm(way * LEVEL) < 0.01
        if over and abs(way[2]) < 0.004:
            self.placed = True
        if self.placed:  # and away
            return self.action(np.clip(way[2] + 0.1, 0, 0.03) * UP, OPEN)
        self.lifted = self.lifted or way[2] < 0
        if not self.lifted:
            return self.action((way[2] + self.LIFT) * UP, CLOSED)
        return self.action(way + (0 if over else self.LIFT) * UP, CLOSED)


class LiftPegUpright(Grasp):
    """
    Takes the peg near one end so loosely that it turns between the fingers, lifts it until it hangs down, and puts it down.
    (The controller turns the hand by 0.04 rad a step: too slowly to turn the peg itself within the 50 steps of an episode.)
    """

    controllers = ("pd_ee_delta_pose",)
    #: The fingers turn the peg as they close: the hand need not have turned all the way. Then it goes down from close by
    TURNED, CLEARANCE = 0.7, 0.035
    #: Metres from the peg's middle to the grasp, along the peg and upwards
    BEYOND, HIGHER = 0.09, 0.01
    #: Of the gripper's action: 3 N on the peg, which hold it, and let it turn
    LOOSE = 0.2
    #: Metres that its foot hangs above the table; radians from upright at which it is put down
    HANGING, UPRIGHT = 0.015, 0.15

    def grip(self) -> np.ndarray:
        return self.position(self.task.peg) + self.BEYOND * self.rotation(self.task.peg)[:, 0] + self.HIGHER * UP

    def grip_angle(self) -> float:
        along = self.rotation(self.task.peg)[:, 0]
        return float(np.arctan2(along[1], along[0])) + np.pi / 2

    def carry(self) -> np.ndarray:
        hand, peg, along = self.hand, self.position(self.task.peg), self.rotation(self.task.peg)[:, 0]
        upright = np.arccos(min(1.0, along[2])) < self.UPRIGHT
        foot = peg[2] - self.task.peg_half_length
        self.placed = self.placed or bool(upright and foot < 0.004)
        if self.placed:
            return self.action(np.zeros(3), OPEN)
        height = self.task.peg_half_length + (hand - peg) @ along + (0 if upright else self.HANGING)
        return self.action((height - hand[2]) * UP, self.LOOSE)


# ---------------------------------------------------------------------- pushing


class PushCube(Expert):
    """With closed fingers down behind the cube, and along to the goal."""

    #: Along the table, away from the robot
    AHEAD = np.array([1.0, 0.0, 0.0])
    #: Metres from the cube's middle to where the hand goes down, and above the table from where
    BEHIND, CLEARANCE = 0.06, 0.12
    #: Metres that a step pushes at most: a cube that is hit faster slides on
    PUSH = 0.04

    def __init__(self, task: Any, row: int):
        super().__init__(task, row)
        self.behind, self.down = False, False

    def act(self) -> np.ndarray:
        hand, cube, goal = self.hand, self.position(self.task.obj), self.position(self.task.goal_region)
        start = cube - self.BEHIND * self.AHEAD
        if not self.behind:
            self.behind = bool(np.linalg.norm((start - hand) * LEVEL) < 0.02)
            return self.action((start - hand) * LEVEL + max(self.CLEARANCE - hand[2], 0.0) * UP, CLOSED)
        if not self.down:
            self.down = bool(abs(cube[2] - hand[2]) < 0.015)
            return self.action(start - hand, CLOSED)
        left = float((goal - cube) @ self.AHEAD)
        aside = (cube - hand) * LEVEL
        aside -= (aside @ self.AHEAD) * self.AHEAD
        return self.action(np.clip(left, 0, self.PUSH) * self.AHEAD + aside + (cube[2] - hand[2]) * UP, CLOSED)


class PullCube(PushCube):
    """The same from the other side."""

    AHEAD = np.array([-1.0, 0.0, 0.0])


EXPERTS: dict[str, type[Expert]] = {
    "PickCube-v1": PickCube,
    "LiftCube-v1": LiftCube,
    "PushCube-v1": PushCube,
    "PullCube-v1": PullCube,
    "StackCube-v1": StackCube,
    "LiftPegUpright-v1": LiftPegUpright,
    "PickSingleYCB-v1": PickObject,
    "PickSingleEGAD-v1": PickObject,
}
"""By ManiSkill's names of the tasks."""


def why_not(env_id: str, task: Any) -> str | None:
    """
    :param env_id: ManiSkill's name of the task
    :param task: the ManiSkill environment
    :return: why no expert acts there, and the cure; None: one does
    """
    if env_id not in EXPERTS:
        return f"{env_id} has no scripted expert; these tasks have one: {', '.join(EXPERTS)}."
    if task.agent.uid not in ROBOTS:
        return f"The scripted experts move {' and '.join(ROBOTS)}, not {task.agent.uid}: leave robot_uids away."
    controllers = EXPERTS[env_id].controllers
    if task.control_mode not in controllers:
        return (
            f"The scripted expert of {env_id} gives actions of {' and '.join(controllers)}, this environment has "
            f"{task.control_mode}. Make it with control_mode={controllers[0]!r}."
        )
    return None


def make_expert(env_id: str, task: Any, row: int) -> Expert:
    """
    :param env_id: ManiSkill's name of the task
    :param task: the ManiSkill environment
    :param row: which of its parallel scenes
    :raises ValueError: if there is none, see :func:`why_not`
    """
    reason = why_not(env_id, task)
    if reason is not None:
        raise ValueError(reason)
    return EXPERTS[env_id](task, row)
