"""Gains of the arm's PD controller, which the report leaves out (B.3 compares controllers at the robot's own)."""

from typing import Any, NamedTuple


class Gains(NamedTuple):
    """
    :param stiffness: proportional gain, N m / rad; None: the robot's own
    :param damping: derivative gain, N m s / rad; None: the robot's own
    """

    stiffness: float | None = None
    damping: float | None = None

    def check(self) -> "Gains":
        """
        :return: these gains
        :raises ValueError: for what is no gain
        """
        for name, value in self._asdict().items():
            if value is not None and not (isinstance(value, (int, float)) and 0 < value < float("inf")):
                raise ValueError(f"{name} must be a number above 0, or None for the robot's own, got {value!r}.")
        return self

    def give(self, env: Any) -> None:
        """
        To the controllers of the arm; those of the gripper keep theirs.

        :param env: the ManiSkill environment, whose robots have just been built
        :raises ValueError: if no controller has such a gain
        """
        wanted = {name: value for name, value in self._asdict().items() if value is not None}
        if not wanted:
            return
        for agent in getattr(env.agent, "agents", [env.agent]):
            parts = getattr(agent.controller, "controllers", {"arm": agent.controller})
            taken = [part for name, part in parts.items() if "gripper" not in name]
            taken = [part for part in taken if all(getattr(part.config, name, None) is not None for name in wanted)]
            if not taken:
                raise ValueError(
                    f"{' and '.join(wanted)}: the controller {agent.control_mode!r} of {agent.uid!r} has no such gain. Leave "
                    "out what it lacks, or choose another control_mode."
                )
            for part in taken:
                for name, value in wanted.items():
                    setattr(part.config, name, value)
                part.set_drive_property()


OWN_GAINS = Gains()
"""Those of the robot."""
