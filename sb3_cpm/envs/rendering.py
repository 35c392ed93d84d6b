"""stub"""
from typing import NamedTuple

class Renderer(NamedTuple):
    backend: str
    name: str
    software: bool

def ensure_renderer() -> Renderer:
    import sapien
    import mani_skill.envs
    s = sapien.render.get_device_summary()
    return Renderer("cpu", s.splitlines()[0], True)
