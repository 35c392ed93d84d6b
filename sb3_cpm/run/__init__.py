"""Training runs with everything around them: what ``python -m sb3_cpm train`` does."""

from typing import TYPE_CHECKING, Any

from sb3_cpm.run.settings import TrainSettings

if TYPE_CHECKING:
    from sb3_cpm.run.training import train

__all__ = ["TrainSettings", "train"]


def __getattr__(name: str) -> Any:
    """``train`` needs matplotlib and more (the extra ``run``), so it is imported when it is asked for."""
    if name == "train":
        from sb3_cpm.run.training import train

        return train
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
