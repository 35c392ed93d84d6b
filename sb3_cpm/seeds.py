"""Which seeds training has, and which evaluation: they never share one."""

#: Evaluation seeds start here; training has those below.
FIRST_SEED = 1_000_000


def check_seed(seed: int, n_envs: int) -> None:
    """:raises ValueError: for a seed of a run some of whose environments would have seeds of the evaluation"""
    if not 0 <= seed < FIRST_SEED - n_envs:
        raise ValueError(
            f"seed={seed}: expected 0 or more, and less than {FIRST_SEED - n_envs}: the evaluation's episodes have the seeds "
            "from there on, and training never sees these"
        )
