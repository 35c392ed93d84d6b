"""What setup.cfg cannot say: where ``zoo_configs/`` goes in a wheel, and README as a package index shows it."""

import configparser
import re
from pathlib import Path

ROOT = Path(__file__).parent


def readme(text: str, repository: str) -> str:
    """
    On a package index relative links lead nowhere.

    >>> readme("see [docs](docs/files.md)", ""), readme("see [docs](docs/files.md)", "https://host/repository")
    ('see docs', 'see [docs](https://host/repository/blob/main/docs/files.md)')

    :param text: of README.md
    :param repository: its address, "" if there is none
    :return: the same with links into the repository made absolute, or plain text; then without pictures
    """

    def absolute(link: "re.Match[str]") -> str:
        mark, label, target = link.groups()
        if repository and not target.startswith("#"):
            return f"{mark}[{label}]({repository}/{'raw' if mark else 'blob'}/main/{target})"
        return "" if mark else label

    return re.sub(r"(!?)\[([^]]*)\]\((?![a-z]+:)([^)]+)\)", absolute, text)


def source_url() -> str:
    """:return: what setup.cfg has for ``Source`` among its ``project_urls``"""
    config = configparser.ConfigParser(interpolation=None)
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    lines = config.get("metadata", "project_urls", fallback="").splitlines()
    urls = {name.strip(): url.strip() for name, _, url in (line.partition("=") for line in lines)}
    return urls.get("Source", "").rstrip("/")


if __name__ == "__main__":
    from setuptools import find_packages, setup

    setup(
        # files of agents lie beside the package in a checkout and within it in a wheel
        packages=[*find_packages(include=["sb3_cpm", "sb3_cpm.*"]), "sb3_cpm.zoo_configs"],
        package_dir={"sb3_cpm.zoo_configs": "zoo_configs"},
        long_description=readme((ROOT / "README.md").read_text(encoding="utf-8"), source_url()),
    )
