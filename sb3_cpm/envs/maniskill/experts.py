"""
Scripted controllers that solve tasks of ManiSkill, as a source of demonstrations that needs no motion planner.

They know where things are, move the hand step by step in proportion to what is left, and go on holding the goal once they are
there. One is made when it is asked for its first action (``expert_action()`` of the environment), and forgotten when the
episode ends.
"""

from typing import Any

import numpy as np

#: Metres of motion that an action of 1 asks for
REACH = 0.1
OPEN, CLOSED = 1.0, -1.0
#: Controllers whose actions the experts give: translation, rotation where there is one, fingers.
CONTROLLERS = ("pd_ee_delta_pose", "pd_ee_delta_pos")


class Expert:
    """
    :param task: the ManiSkill environment
    :param row: which of its parallel scenes
    """

    def __init__(self, task: Any, row: int):
        self.task = task
        self.row = row

    def position(self, thing: Any) -> np.ndarray:
        """:return: of an object or pose, metres, shape ``(3,)``"""
        return getattr(thing, "pose", thing).p[self.row].cpu().numpy()

    def action(self, move: np.ndarray, gripper: float) -> np.ndarray:
        """
        :param move: metres
        :param gripper: :data:`OPEN` or :data:`CLOSED`
        """
        n_rotations = self.task.single_action_space.shape[0] - 4
        return np.concatenate([np.clip(move / REACH, -1, 1), np.zeros(n_rotations), [gripper]]).astype(np.float32)

    def act(self) -> np.ndarray:
        """:return: the next action, in [-1, 1]"""
        raise NotImplementedError


class PickCube(Expert):
    """Above the cube, down, close, and to the goal."""

    above, closing = False, 0

    def act(self) -> np.ndarray:
        hand, cube = self.position(self.task.agent.tcp), self.position(self.task.cube)
        if self.closing >= 2:
            return self.action(self.goal() - cube, CLOSED)
        if self.above and np.linalg.norm(hand - cube) < 0.012:
            self.closing += 1
            return self.action(cube - hand, CLOSED)
        self.above = self.above or bool(np.linalg.norm(hand[:2] - cube[:2]) < 0.01)
        return self.action(cube + np.array([0, 0, 0 if self.above else 0.08]) - hand, OPEN)

    def goal(self) -> np.ndarray:
        """:return: where the cube is to be, metres"""
        return self.position(self.task.goal_site)


class LiftCube(PickCube):
    """A little higher than asked for."""

    def goal(self) -> np.ndarray:
        return self.position(self.task.goal_site) + np.array([0, 0, 0.01])


class PushCube(Expert):
    """With closed fingers down behind the cube, and along the line to the goal."""

    #: Metres from the cube's middle to where the hand goes down, and above the table before that.
    BEHIND, CLEARANCE = 0.05, 0.12
    #: Which way the goal lies, in the table's plane.
    AHEAD = np.array([1.0, 0.0, 0.0])
    down = False

    def act(self) -> np.ndarray:
        hand, cube, goal = map(self.position, (self.task.agent.tcp, self.task.obj, self.task.goal_region))
        ahead, behind = self.AHEAD, cube - self.BEHIND * self.AHEAD
        self.down = self.down or bool(np.linalg.norm(hand[:2] - behind[:2]) < 0.015)
        if not self.down:
            # up first where the cube is in the way
            free = hand[2] > self.CLEARANCE - 0.03 or (hand - behind) @ ahead < 0.02
            return self.action((np.array([*behind[:2], self.CLEARANCE]) - hand) * ([1, 1, 1] if free else [0, 0, 1]), CLOSED)
        lower = np.array([0, 0, self.task.cube_half_size - hand[2]])
        if abs(lower[2]) > 0.02:
            return self.action(lower + (behind - hand) * [1, 1, 0], CLOSED)
        left = float((goal - cube) @ ahead)
        sideways = (cube - hand) * [1, 1, 0]
        return self.action(lower + sideways - (sideways @ ahead) * ahead + (left if left > 0.01 else 0.0) * ahead, CLOSED)


class PullCube(PushCube):
    """The same from the other side."""

    AHEAD = -PushCube.AHEAD


EXPERTS: dict[str, type[Expert]] = {
    "PickCube-v1": PickCube,
    "LiftCube-v1": LiftCube,
    "PushCube-v1": PushCube,
    "PullCube-v1": PullCube,
}
"""By ManiSkill's names of the tasks."""


def make_expert(env_id: str, task: Any, row: int) -> Expert:
    """
    :param env_id: ManiSkill's name of the task
    :param task: the ManiSkill environment
    :param row: which of its parallel scenes
    :raises ValueError: if nobody has written one for it, or for its controller
    """
    if env_id not in EXPERTS:
        raise ValueError(f"{env_id} has no scripted expert; these tasks have one: {', '.join(EXPERTS)}.")
    if task.control_mode not in CONTROLLERS:
        raise ValueError(
            f"Scripted experts give actions of the controllers {' and '.join(CONTROLLERS)}, this environment has "
            f"{task.control_mode}. Make it with control_mode={CONTROLLERS[0]!r}."
        )
    return EXPERTS[env_id](task, row)
