"""Hooks of the site's build: the command line from its parser, LaTeX to MathML, and the switch of the Python API."""

from __future__ import annotations

import argparse
import html
import re
import sys
from collections.abc import Callable
from pathlib import Path

import latex2mathml.converter

sys.path.insert(0, str(Path(__file__).parent.parent))

from bokehguide.cli.arguments import make_parser

FENCED = re.compile(r"^(?P<fence>```+|~~~+).*?^(?P=fence)[ \t]*$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"`[^`\n]+`")
DISPLAYED = re.compile(r"^(?P<indent>[ \t]*)\$\$\s*(?P<latex>.+?)\s*\$\$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"(?<![\\$\w])\$(?P<latex>[^$\n]+?)\$(?![\d$])")
COMMANDS = "<!-- commands -->"
IDENTIFIER = re.compile(r"^::: (?P<name>\S+)$", re.MULTILINE)


def on_page_markdown(markdown: str, page, config, files) -> str:
    """Insert the generated parts of a page before Markdown is converted."""
    if COMMANDS in markdown:
        markdown = markdown.replace(COMMANDS, command_line())
    if not config.extra["api"]:
        markdown = IDENTIFIER.sub(lambda match: f"- `{match['name']}`", markdown)
    return outside_code(markdown, to_mathml)


def outside_code(markdown: str, change: Callable[[str], str]) -> str:
    """`markdown` with `change` applied to all but code, in fences or in backticks."""
    kept: list[str] = []

    def hide(match: re.Match) -> str:
        kept.append(match[0])
        return f"\0{len(kept) - 1}\0"

    changed = change(CODE.sub(hide, FENCED.sub(hide, markdown)))
    while "\0" in changed:  # inline code may stand in a hidden fence
        changed = re.sub("\0(\\d+)\0", lambda match: kept[int(match[1])], changed)
    return changed


def to_mathml(markdown: str) -> str:
    """Replace `$$ … $$` and `$ … $` by MathML, which browsers show without a script."""

    def block(match: re.Match) -> str:
        return f'{match["indent"]}<div class="equation">{convert(match["latex"], "block")}</div>'

    def inline(match: re.Match) -> str:
        # In a span, as Markdown takes a line that starts with <math> for a block.
        return f"<span>{convert(match['latex'], 'inline')}</span>"

    return INLINE.sub(inline, DISPLAYED.sub(block, markdown))


def convert(latex: str, display: str) -> str:
    return latex2mathml.converter.convert(" ".join(latex.split()), display=display)


def command_line() -> str:
    """A section for each command, with a table of its arguments, from the parser that the command itself uses."""
    parser = make_parser()
    (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    summaries = {choice.dest: choice.help for choice in commands._choices_actions}
    return "\n\n".join(section(name, summaries[name], command) for name, command in commands.choices.items())


def section(name: str, summary: str, command: argparse.ArgumentParser) -> str:
    usage = " ".join([f"bokehguide {name}", *(action.metavar for action in command._get_positional_actions()), "[options]"])
    lines = [f"## `bokehguide {name}`", "", f"{sentence(summary)}", "", "```text", usage, "```"]
    for group in command._action_groups:
        actions = [action for action in group._group_actions if not isinstance(action, argparse._HelpAction)]
        if actions:
            title = {"positional arguments": "Arguments", "options": "Options"}.get(group.title, group.title.capitalize())
            lines += ["", f"**{title}**", "", "| argument | meaning |", "|---|---|", *map(row, actions)]
    return "\n".join(lines)


def row(action: argparse.Action) -> str:
    metavar = action.metavar or ("|".join(action.choices) if action.choices else action.dest.upper())
    words = [*action.option_strings[:1], *([] if action.nargs == 0 else [metavar])]
    shown = " ".join(f"<code>{html.escape(word).replace('|', '&#124;<wbr>')}</code>" for word in words)
    return f"| {shown} | {sentence(action.help or '').replace('|', '&#124;')} |"


def sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}" + ("" if not text or text.endswith(".") else ".")
