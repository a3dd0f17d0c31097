"""Pages of the documentation that are generated from the code, and the nav entries of guides that nobody listed."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import click
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
FIGURES = "scripts/figures/"


def on_config(config: Any) -> Any:
    """Append the guides that `nav` does not list."""
    guides = next(section["Guides"] for section in config.nav if "Guides" in section)
    for path in sorted((ROOT / "docs" / "guides").glob("*.md")):
        if f"guides/{path.name}" not in guides:
            guides.append(f"guides/{path.name}")
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages, and the figures that scripts write outside docs/."""
    sys.path.insert(0, str(Path(__file__).parent))  # here, since MkDocs resets it after it has loaded a hook
    from messages import page as messages

    pages = {
        "reference/commands.md": commands(),
        "reference/configuration.md": configuration(),
        "reference/messages.md": messages(),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
    }
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    for path in sorted((ROOT / FIGURES).glob("*.png")):
        files.append(File.generated(config, f"figures/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links to scripts/figures, which are right on GitHub, become those of the built pages."""
    return re.sub(
        rf"\]\((\.\./)+{FIGURES}", lambda _: "](" + "../" * page.file.src_uri.count("/") + "figures/", markdown
    )


def commands() -> str:
    """`rgbd-calib CMD --help` of every command."""
    from rgbd_calib.cli.main import COMMANDS, cli

    out = ["# Commands", "", "As `rgbd-calib COMMAND --help` prints them. Shell completion: "]
    out[-1] += '`eval "$(_RGBD_CALIB_COMPLETE=bash_source rgbd-calib)"` (or `zsh_source`, `fish_source`).'
    for name in COMMANDS:
        command = cli.get_command(None, name)  # type: ignore[arg-type]
        assert command is not None
        context = click.Context(command, info_name=f"rgbd-calib {name}", max_content_width=96, terminal_width=96)
        out += ["", f"## {name}", "", "```text", command.get_help(context), "```"]
    return "\n".join(out) + "\n"


def configuration() -> str:
    """Every setting with its default and comment."""
    text = (ROOT / "configs" / "defaults.yaml").read_text(encoding="utf-8")
    return f"# Configuration\n\n`rgbd-calib calibrate --config FILE`; the file may hold any part of this.\n\n```yaml\n{text}```\n"
