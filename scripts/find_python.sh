#!/bin/sh
# Print the path of a Python 3.10 to 3.12 that can make a virtual environment, or say on stderr what to do.
# Usage: find_python.sh [interpreter to prefer]
set -eu

works() { # version in range, and pip can be put into a new environment
    "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))' >/dev/null 2>&1
}
makes_venv() {
    "$1" -c 'import ensurepip, venv' >/dev/null 2>&1
}

[ -n "${1:-}" ] || set -- python3 python3.12 python3.11 python3.10
fitting=""
for name in "$@"; do
    if works "$name"; then
        if makes_venv "$name"; then
            "$name" -c 'import sys; print(sys.executable)'
            exit 0
        fi
        fitting="${fitting:-$name}"
    fi
done

# Debian and Ubuntu ship python3 without what `python3 -m venv` needs.
if [ -n "$fitting" ]; then
    package="$("$fitting" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')"
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        echo "Installing $package, which \`$fitting -m venv\` needs" >&2
        (apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "$package") >&2 </dev/null
        "$fitting" -c 'import sys; print(sys.executable)'
        exit 0
    fi
    echo "$fitting cannot make virtual environments here. Install it once with: sudo apt-get install $package" >&2
else
    echo "No Python 3.10, 3.11 or 3.12 found (looked for: $*)." >&2
    echo "Install one (sudo apt-get install python3 python3-venv), or name yours: make PYTHON=/path/to/python3.11 ..." >&2
fi
exit 1
