"""What SB3 logs, as a table. Apart from the tables themselves, which are read without SB3."""

from typing import Any

from stable_baselines3.common.logger import KVWriter

from sb3_cpm.run.tables import Table


class DiagnosticsWriter(KVWriter):
    """
    SB3 logger output: every number that is logged, as rows ``step, name, value``.

    :param table: where they go
    """

    def __init__(self, table: Table) -> None:
        self.table = table

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.table.add_all(
            (step, name, float(value))
            for name, value in sorted(key_values.items())
            if not name.startswith("time/") and hasattr(value, "__float__")
        )

    def close(self) -> None:
        self.table.close()
