"""
Are files with flipped bits refused? One random bit in each of many copies of what a run saves::

    python benchmarks/flipped_bits.py --copies 50

A file that is read although it was changed is a miss; so is one that cannot be read although it was not.
"""

import argparse
import random
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sb3_cpm import CPMBuffer
from sb3_cpm.agents import load_agent
from sb3_cpm.challenger import Challenger
from sb3_cpm.checkpoint import find_checkpoint, save_checkpoint

SMALL = {
    "policy_kwargs": {"net_arch": [8]},
    "learning_starts": 60,
    "batch_size": 8,
    "buffer_size": 500,
    "train_freq": 10,
    "gradient_steps": 1,
    "callback": {"sb3_cpm.ChallengerCallback": {"train_freq": 50, "challenger_kwargs": {"batch_size": 2}}},
}


def main() -> int:
    """:return: 0 if every changed file was refused and every whole one read"""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--copies", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        save(folder)
        misses = [
            count("challenger", folder / "challenger.pt", lambda path: Challenger.load(path, "cpu"), options),
            count("replay buffer", folder / "replay_buffer.npz", CPMBuffer.load, options),
            count("checkpoint", folder / "checkpoint", lambda path: find_checkpoint(path.parent), options),
        ]
    return int(any(misses))


def save(folder: Path) -> None:
    """A short run of CPM-SAC on the toy task, as far as it has files."""
    built = load_agent("cpm_sac", "CPMToy-v0", SMALL).build(seed=0, device="cpu")
    built.model.learn(300, callback=built.callbacks)
    built.model.replay_buffer.save(folder / "replay_buffer.npz")
    built.callbacks[0].save(folder / "challenger.pt")
    save_checkpoint(folder, built.model, built.callbacks, {"seconds": 1.0})
    built.env.close()


def count(name: str, saved: Path, load: Callable[[Path], Any], options: argparse.Namespace) -> int:
    """:return: how many of the copies were read although a bit was flipped; prints that"""
    rng, refused = random.Random(options.seed), 0
    load(saved)  # as it is, it can be read
    files = [saved] if saved.is_file() else sorted(saved.iterdir())
    sizes = [path.stat().st_size for path in files]
    for number in range(options.copies):
        copy = saved.parent / f"copy{number}" / saved.name
        (shutil.copytree if saved.is_dir() else _copy)(saved, copy)
        (chosen,) = rng.choices(files, sizes)  # every bit of a checkpoint is as likely
        flip(copy if saved.is_file() else copy / chosen.name, rng)
        try:
            load(copy)
        except ValueError:
            refused += 1
        shutil.rmtree(copy.parent)
    print(f"{name}: {refused} of {options.copies} copies with a flipped bit were refused ({sum(sizes):,} bytes)")
    return options.copies - refused


def flip(path: Path, rng: random.Random) -> None:
    """Change one bit of a file."""
    content = bytearray(path.read_bytes())
    place = rng.randrange(8 * len(content))
    content[place // 8] ^= 1 << place % 8
    path.write_bytes(content)


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir()
    shutil.copy(source, target)


if __name__ == "__main__":
    raise SystemExit(main())
