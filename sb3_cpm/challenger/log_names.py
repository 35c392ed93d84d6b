"""Names in the log that stay apart where SB3 cuts them off."""

from collections.abc import Sequence

LONGEST_KEY = 27  # SB3 prints 36 characters of a name: 3 to indent it, "error_", and what is left


def short_names(keys: Sequence[str]) -> dict[str, str]:
    """
    Names for the log that differ from each other also where SB3 prints only their beginning.

    :param keys: of observations
    :return: keys of up to ``LONGEST_KEY`` characters as they are, of longer ones beginning and end; where two would look the
        same, numbers tell them apart
    """
    names = {key: key for key in keys if len(key) <= LONGEST_KEY}
    for key in keys:
        number = 1
        while key not in names:
            mark = "..." if number == 1 else f"..{number}.."
            left = LONGEST_KEY - len(mark)
            name = key[: left // 3] + mark + key[-(left - left // 3) :]
            number += 1
            if name not in names.values():
                names[key] = name
    return names
