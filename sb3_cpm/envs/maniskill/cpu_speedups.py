"""
The same numbers for less work.

Without a GPU, half of a step of ManiSkill is hundreds of small torch calls on batches of one, each of them some microseconds.
Part of that work is done twice or comes to nothing, and is left out here, in the environments that we make and nowhere else:

* the pose of a thing becomes four tensors and two arrays before it is one
* the end-effector controllers ask twice per action where the hand is, and the second answer is not used on a CPU
* whether the gripper grasps something is worked out from angles between forces, even where there is no force
* the renderer transforms the triangles of hidden things (the goal marker: a tenth of all) and then draws none of them

States, rewards and pictures are equal to the last bit (``tests/test_cpu_speedups.py``). Simulations on a GPU stay as they are.
"""

import functools
from typing import Any

import numpy as np
import torch as th


def speed_up(env: Any) -> None:
    """
    Call this after every building of the scene, which makes new robots and things.

    :param env: the unwrapped ManiSkill environment
    """
    if env.scene.gpu_sim_enabled:
        return
    for agent in getattr(env.agent, "agents", [env.agent]):
        if agent is not None:
            _speed_up_grasps(agent)
            for controller in agent.controllers.values():
                _speed_up_poses(controller)
    links = [link for articulation in env.scene.articulations.values() for link in articulation.links]
    for thing in (*env.scene.actors.values(), *links):
        if len(thing._objs) == 1:
            thing.__class__ = _poses_at_once(type(thing))  # type: ignore[arg-type]
    for thing in env._hidden_objects:
        if hasattr(thing, "hidden"):
            _speed_up_hidden(thing)


# ---------------------------------------------------------------------- where things are
@functools.cache
def _poses_at_once(thing_class: Any) -> Any:
    """
    :param thing_class: ``Actor`` or ``Link``, or a subclass
    :return: a subclass whose pose is made from the simulator's numbers in one go
    """
    from mani_skill.utils.structs import Actor, Pose

    if thing_class.__dict__.get("_poses_at_once"):  # after another building of the scene
        return thing_class
    name = "pose" if issubclass(thing_class, Actor) else "entity_pose"

    class PosesAtOnce(thing_class):
        _poses_at_once = True

        def _pose(self) -> Any:
            pose = getattr(self._objs[0], name)
            return Pose(th.from_numpy(np.concatenate((pose.p, pose.q))[None]))

        pose = property(_pose, thing_class.pose.fset)

    PosesAtOnce.__name__ = PosesAtOnce.__qualname__ = thing_class.__name__
    return PosesAtOnce


# ---------------------------------------------------------------------- where the hand is
def _speed_up_poses(controller: Any) -> None:
    from mani_skill.agents.controllers.base_controller import CombinedController
    from mani_skill.agents.controllers.pd_ee_pose import PDEEPosController

    if isinstance(controller, CombinedController):
        for part in controller.controllers.values():
            _speed_up_poses(part)
    elif isinstance(controller, PDEEPosController):
        controller.__class__ = _asks_once(type(controller))  # type: ignore[arg-type]


@functools.cache
def _asks_once(controller_class: Any) -> Any:
    """
    :param controller_class: an end-effector controller
    :return: a subclass that works out where the hand is once per action, and the base's inverse pose when the base moved
    """

    class AsksOnce(controller_class):
        _now: Any = None
        _base: Any = None

        @property
        def ee_pose_at_base(self) -> Any:
            if self._now is not None:
                return self._now
            base = self.root_link.pose
            if self._base is None or not th.equal(base.raw_pose, self._base[0].raw_pose):
                self._base = base, base.inv()
            return self._base[1] * self.ee_pose

        def set_action(self, action: Any) -> None:
            self._now = self.ee_pose_at_base
            try:
                super().set_action(action)
            finally:
                self._now = None

    AsksOnce.__name__ = AsksOnce.__qualname__ = controller_class.__name__
    return AsksOnce


# ---------------------------------------------------------------------- whether it grasps
def _speed_up_grasps(agent: Any) -> None:
    from mani_skill.agents.robots.panda.panda import Panda

    if type(agent).is_grasping is Panda.is_grasping:  # not for a robot that defines grasping in a way of its own
        agent.is_grasping = functools.partial(_is_grasping, agent)


def _is_grasping(agent: Any, object: Any, min_force: float = 0.5, max_angle: float = 85) -> th.Tensor:
    """ManiSkill's question, with its names: both fingers must press, so without contact to both the answer is no."""
    if min_force > 0:
        thing = object._bodies[0].entity
        pairs = [[body.entity for body in contact.bodies] for contact in agent.scene.px.get_contacts()]
        touching = [one if other == thing else other for one, other in pairs if thing in (one, other)]
        fingers = (agent.finger1_link, agent.finger2_link)
        if not all(finger._bodies[0].entity in touching for finger in fingers):
            return th.zeros(1, dtype=th.bool)
    return type(agent).is_grasping(agent, object, min_force=min_force, max_angle=max_angle)


# ---------------------------------------------------------------------- what is hidden
def _speed_up_hidden(thing: Any) -> None:
    """ManiSkill makes hidden things transparent; here they also leave the renderer's list for as long as they are hidden."""
    thing.hide_visual = functools.partial(_hide, thing)
    thing.show_visual = functools.partial(_show, thing)
    if thing.hidden:
        for component in _drawn(thing):
            component.disable()


def _hide(thing: Any) -> None:
    if not thing.hidden:
        type(thing).hide_visual(thing)
        for component in _drawn(thing):
            component.disable()


def _show(thing: Any) -> None:
    if thing.hidden:
        for component in _drawn(thing):
            component.enable()
        type(thing).show_visual(thing)


def _drawn(thing: Any) -> list[Any]:
    import sapien

    return [entity.find_component_by_type(sapien.render.RenderBodyComponent) for entity in thing._objs]
