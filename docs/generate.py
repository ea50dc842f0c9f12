"""Makes the pages of docs/reference that are read off the code: api, options, scene-fields, materials,
command-line and serve-protocol.

mkdocs calls `on_files` (a hook of mkdocs.yml): the pages are made while the site is built and lie in no folder.

    python docs/generate.py [FOLDER]     prints their names, or writes them into FOLDER to look at
"""

import ast
import contextlib
import inspect
import io
import os
import re
import sys
import textwrap
import tokenize
from collections.abc import Iterable, Iterator
from dataclasses import is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, get_args, get_type_hints
from unittest.mock import patch

WIDTH = 100  #: characters of a line of help and of a signature
LONGEST = 120  #: characters of a field with its comment


def pages() -> dict[str, str]:
    """{path under docs: Markdown} of all generated pages."""
    return {
        "reference/api.md": api_page(),
        "reference/options.md": options_page(),
        "reference/scene-fields.md": scene_page(),
        "reference/materials.md": materials_page(),
        "reference/command-line.md": command_page(),
        "reference/serve-protocol.md": protocol_page(),
    }


def on_files(files: Any, config: Any) -> Any:
    """The hook: the pages join those of the folder."""
    from mkdocs.structure.files import File

    for path, text in pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def api_page() -> str:
    """Every public name with its signature and docstring."""
    import spacesim as ss
    from spacesim.scenes.spacecraft import Part
    from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera, Projection
    from spacesim.torch import rasterization

    cameras = Projection, Orthographic, OrthographicCamera
    others = sorted({*named_by(ss), Part} - {*cameras}, key=lambda cls: cls.__name__)
    parts = [
        "# API",
        f"Generated from the docstrings of spacesim {ss.__version__}. `import spacesim as ss` gives the names below; "
        "nothing heavy is loaded before one is used. Equation numbers are explained in "
        "[equations](../explanation/equations.md).",
        "## Functions",
        *(function_entry(f"ss.{name}", getattr(ss, name)) for name in functions(ss)),
        "## Records",
        *(class_entry(f"ss.{name}", getattr(ss, name)) for name in classes(ss)),
        "## Errors",
        *(f"### ss.{name}\n\n{block(inspect.getdoc(getattr(ss, name)) or '')}" for name in errors(ss)),
        "## What these take and give",
        *(class_entry(f"{cls.__module__}.{cls.__name__}", cls, False) for cls in others),
        "## Torch",
        function_entry("spacesim.torch.rasterization", rasterization),
        "## Cameras of arrays",
        *(class_entry(f"spacesim.splat.raster.cameras.{cls.__name__}", cls) for cls in cameras),
    ]
    return "\n\n".join(parts) + "\n"


def named_by(module: Any) -> list[type]:
    """Our classes that signatures, fields and methods of a module's public names name, by their names, but for those
    that are public themselves and for records of configurations, which have pages of their own."""
    public = {name: getattr(module, name) for name in module.__all__}
    found = {cls for thing in public.values() for cls in classes_in(annotations(thing, public))}
    configured = [cls for name, cls in public.items() if name.endswith("Config")]
    for cls in configured:  # grows while it is read
        inner = classes_in(get_type_hints(cls).values()) if is_dataclass(cls) else ()
        configured += [record for record in inner if record not in configured]
    ours = {cls for cls in found if cls.__module__.startswith(module.__name__)}
    rigs = {cls for cls in ours if inspect.isabstract(cls)}  # of which the pages have what can be made
    return sorted(ours - {*public.values(), *configured} | rigs, key=lambda cls: cls.__name__)


def annotations(thing: Any, names: dict[str, Any]) -> list[Any]:
    """Of a function's signature, or of a class's fields and public methods; of an error none."""
    if is_error(thing):
        return []
    hints = list(get_type_hints(thing, localns=names).values()) if not inspect.isclass(thing) else []
    for cls in inspect.getmro(thing) if inspect.isclass(thing) else ():
        hints += [hint for name, hint in get_type_hints(cls, localns=names).items() if not name.startswith("_")]
        functions = [unwrapped(member) for name, member in vars(cls).items() if not name.startswith("_")]
        for function in filter(inspect.isfunction, functions):
            hints += get_type_hints(function, localns=names).values()
    return hints


def classes_in(hints: Iterable[Any]) -> Iterator[type]:
    """The classes that annotations name."""
    for hint in hints:
        if inspect.isclass(hint) and not get_args(hint):
            yield hint
        yield from classes_in(hint if isinstance(hint, list) else get_args(hint))


def functions(module: Any) -> list[str]:
    return [name for name in module.__all__ if inspect.isfunction(getattr(module, name))]


def errors(module: Any) -> list[str]:
    return [name for name in module.__all__ if is_error(getattr(module, name))]


def classes(module: Any) -> list[str]:
    return [name for name in module.__all__ if inspect.isclass(getattr(module, name)) and name not in errors(module)]


def is_error(thing: Any) -> bool:
    return inspect.isclass(thing) and issubclass(thing, Exception)


def block(text: str, language: str = "text") -> str:
    return f"```{language}\n{text.strip()}\n```"


def function_entry(title: str, function: Any) -> str:
    name = title.rsplit(".", 1)[-1]
    return f"### {title}\n\n{block(signature(function, name), 'python')}\n\n{block(inspect.getdoc(function) or '')}"


def class_entry(title: str, cls: Any, with_methods: bool = True) -> str:
    """A class: its fields as they stand in the code, and what can be asked of it. with_methods: of a record, too"""
    parts = [f"### {title}", block(inspect.getdoc(cls) or "")]
    if fields := list(all_field_lines(cls)):
        parts.append(block("\n".join(fields), "python"))
    for name, member in members(cls) if with_methods or not fields else ():
        own, said = f"{title.removeprefix('ss.')}.{name}", inspect.getdoc(member) or ""
        if inspect.isfunction(member):
            parts.append(f"{block(signature(member, own), 'python')}\n\n{block(said)}")
        else:
            parts.append(f"`{own}`\n\n{block(said)}")
    return "\n\n".join(parts)


def all_field_lines(cls: type) -> Iterator[str]:
    """`field_lines` of a class, after those of the records that it extends."""
    bases = [base for base in reversed(cls.__mro__) if is_dataclass(base)]
    for record in dict.fromkeys([*bases, cls]):
        yield from field_lines(record)


def field_lines(cls: type) -> Iterator[str]:
    """Fields as they stand in the code, each with its comment beside it, or above it where both are too long for a
    line, and with the values of constants in the place of their names."""
    source = textwrap.dedent(inspect.getsource(cls))
    definition = ast.parse(source).body[0]
    assert isinstance(definition, ast.ClassDef)
    comments = comments_in(source)
    code = without_comments(source)
    for statement in definition.body:
        if not isinstance(statement, ast.AnnAssign) or ast.unparse(statement.target).startswith("_"):
            continue
        assert isinstance(statement.target, ast.Name)
        assert statement.end_lineno is not None
        text = f"{statement.target.id}: {flattened(code, statement.annotation)}"
        if isinstance(statement.value, ast.Name):
            default = getattr(cls, statement.target.id)
            text += f" = {f'{default:.6g}' if isinstance(default, float) else repr(default)}"
        elif statement.value is not None:
            text += f" = {flattened(code, statement.value)}"
        above = statement.lineno - 1
        while above in comments and comments[above][0]:
            above -= 1
        said = [comments[line][1] for line in range(above + 1, statement.end_lineno + 1) if line in comments]
        comment = f"#: {' '.join(said)}"
        if len(f"{text}  {comment}") > LONGEST:
            yield f"{textwrap.fill(comment, LONGEST, subsequent_indent='#: ')}\n{text}"
        else:
            yield f"{text}  {comment}" if said else text


def comment_tokens(source: str) -> list[tokenize.TokenInfo]:
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return [token for token in tokens if token.type == tokenize.COMMENT]


def comments_in(source: str) -> dict[int, tuple[bool, str]]:
    """{line: (whether nothing else stands on it, words)} of the comments that begin with "#:"."""
    tokens = [token for token in comment_tokens(source) if token.string.startswith("#:")]
    return {token.start[0]: (token.line.strip() == token.string, token.string[2:].strip()) for token in tokens}


def without_comments(source: str) -> str:
    """With spaces in their place."""
    lines = source.splitlines()
    for token in comment_tokens(source):
        row, column = token.start
        lines[row - 1] = lines[row - 1][:column] + " " * len(token.string)
    return "\n".join(lines)


def flattened(code: str, node: ast.expr) -> str:
    """An expression as it stands in code, on one line."""
    segment = ast.get_source_segment(code, node)
    assert segment is not None
    if "\n" not in segment:
        return segment
    return re.sub(r",? (?=[\])}])", "", re.sub(r"(?<=[\[({]) ", "", " ".join(segment.split())))


def members(cls: type) -> Iterator[tuple[str, Any]]:
    """(name, function) of the public methods and properties that have a docstring."""
    for name, member in vars(cls).items():
        function = unwrapped(member)
        if not name.startswith("_") and inspect.isfunction(function) and function.__doc__:
            yield name, member if isinstance(member, property | cached_property) else function


def unwrapped(member: Any) -> Any:
    """The function of a property, a static or a class method; anything else as it is."""
    return getattr(member, "fget", None) or getattr(member, "__func__", None) or getattr(member, "func", member)


def signature(function: Any, name: str) -> str:
    """As it is written in the code, without `self`."""
    definition = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(definition, ast.FunctionDef)
    arguments = definition.args
    if arguments.args and arguments.args[0].arg in ("self", "cls"):
        arguments.args = arguments.args[1:]
    parts = [re.sub(r"^([^=]*: [^=]*)=", r"\1 = ", part) for part in split(ast.unparse(arguments))]
    end = f" -> {ast.unparse(definition.returns)}".replace("'", "") if definition.returns else ""
    line = f"{name}({', '.join(parts)}){end}"
    return line if len(line) <= WIDTH else f"{name}(\n    " + ",\n    ".join(parts) + f",\n){end}"


def split(arguments: str) -> list[str]:
    """At the commas that stand in no brackets."""
    parts, depth = [""], 0
    for character in arguments:
        depth += (character in "([{") - (character in ")]}")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts if part.strip()]


def options_page() -> str:
    """Every field of a training's configuration."""
    from spacesim.cli.fields import reference
    from spacesim.nerf.config import NerfConfig

    lead = (
        "Every field of `TrainConfig`, of `NerfConfig` (`--method nerf`) and of the records in them, with the defaults "
        "of the records. `--set KEY=VALUE` takes each but `method` and `preset`, which are options of their own: they "
        "bring what goes with them. `spacesim train --fields` lists all with what preset, method and strategy give "
        "them. The presets are files in `spacesim/assets/presets/`."
    )
    return f"# Options of a training\n\n{lead}\n\n{reference().strip()}\n\n{reference(NerfConfig).strip()}\n"


def scene_page() -> str:
    """Every table of a scene file: the record that it becomes, its fields and their defaults."""
    import spacesim as ss
    from spacesim.data.structure import keys_of
    from spacesim.scenes.cameras.rig import RigConfig
    from spacesim.scenes.rigs import RIGS
    from spacesim.scenes.scenefile import RULES

    records = {name: record_in(hint) for name, hint in get_type_hints(ss.SceneConfig).items()}
    tables: dict[str, type] = {
        "The scene": ss.SceneConfig,
        "[[objects]]": records["objects"],
        "[materials.NAME]": records["materials"],
        "[sun]": records["sun"],
        "[earth]": records["earth"],
        "[background]": records["background"],
        "[rig]": RigConfig,
        **{f'[rig] kind = "{kind}"': cls for kind, cls in RIGS.items()},
        "[camera]": records["camera"],
        "[camera.sensor]": record_in(get_type_hints(records["camera"])["sensor"]),
        "[quality]": records["quality"],
    }
    parts = [
        "# Fields of scene files",
        "Generated from the records that a [scene file](scene-files.md) becomes. A default of None means that leaving "
        "the key out is the only way to have none. Lengths are metres.",
        *(f"## {title}\n\n{record_entry(cls, keys_of(cls, RULES))}" for title, cls in tables.items()),
    ]
    return "\n\n".join(parts) + "\n"


def record_in(hint: Any) -> Any:
    """The record of `tuple[Record, ...]`, `Record | None` and their like."""
    return hint if is_dataclass(hint) else next(filter(None, map(record_in, get_args(hint))), None)


def record_entry(cls: type, keys: Iterable[str]) -> str:
    """A record: its docstring, and those of its fields that are keys of a file, of what it extends too; but what
    `[rig]` says of most rigs is not said again."""
    known = set(keys)
    bases = [base for base in reversed(cls.__mro__) if is_dataclass(base) and base.__name__ != "RigConfig"]
    records = list(dict.fromkeys([*bases, cls]))
    every = [line for record in records for line in field_lines(record)]
    lines = [line for line in every if line.splitlines()[-1].partition(":")[0] in known]
    return f"{block(inspect.getdoc(cls) or '')}\n\n{block(chr(10).join(lines), 'python')}"


def materials_page() -> str:
    """Every row of assets/materials.toml."""
    from spacesim.data.toml import parse

    path = Path(__file__).parents[1] / "spacesim" / "assets" / "materials.toml"
    rows = ["| Material | Kind | Albedo R, G, B | GGX α | Absorptance | From |", "|---|---|---|---|---|---|"]
    for name, values in parse(path.read_text(encoding="utf-8"), path.name).values.items():
        albedo = ", ".join(f"{channel:.3f}" for channel in values.get("albedo", []))
        kind = f"{values['kind']}, n = {values['ior']}" if "ior" in values else values["kind"]
        cells = f"`{name}`", kind, albedo, values.get("roughness", ""), values.get("absorptance", ""), values["source"]
        rows.append(f"| {' | '.join(' '.join(str(cell).split()) for cell in cells)} |")
    lead = (
        "Generated from `spacesim/assets/materials.toml`. Albedo is linear camera RGB, of coated surfaces that of the "
        "base as seen through the coat; the absorptance is over 300 to 2500 nm. Chosen: assumed, not measured. "
        "Table 11.3: Fortescue, Swinerd and Stark, *Spacecraft Systems Engineering*, 4th edition, 2011; Rakic: Appl. "
        "Opt. 34, 4755 (1995)."
    )
    return f"# Table of materials\n\n{lead}\n\n{chr(10).join(rows)}\n"


def command_page() -> str:
    """The help of every command."""
    overview = help_of()
    names = [(name,) for name in commands_in(overview)]
    kinds = [("import", kind) for kind in commands_in(help_of("import"))]
    at = names.index(("import",)) + 1
    names[at:at] = kinds
    parts = [
        "# Command line",
        "The help of every command. Exit codes: 0 done, 1 the work failed, 2 bad usage or bad input: one sentence "
        "names the file or option, what was expected and what was found.",
        block(overview),
        *(f"## spacesim {' '.join(name)}\n\n{block(help_of(*name))}" for name in names),
    ]
    return "\n\n".join(parts) + "\n"


def protocol_page() -> str:
    """What `spacesim serve` is asked and answers: the protocol's own words, its records, the arrays."""
    from spacesim.data.structure import Rules, keys_of
    from spacesim.serve import protocol

    source = inspect.getsource(protocol)
    arrays = textwrap.dedent(source.partition("Output = Literal[\n")[2].partition("\n]")[0])
    records = {"A request": protocol.PictureRequest, "Its camera": protocol.CameraFields}
    parts = [
        "# Protocol of spacesim serve",
        "Generated from `spacesim/serve/protocol.py`; [how to use it](../how-to/closed-loop.md).",
        block(inspect.getdoc(protocol) or ""),
        *(f"## {title}\n\n{record_entry(cls, keys_of(cls, Rules()))}" for title, cls in records.items()),
        f"## Arrays\n\n{block(arrays, 'python')}",
    ]
    return "\n\n".join(parts) + "\n"


def commands_in(text: str) -> list[str]:
    """Names of the commands that a help lists."""
    return re.findall(r"^    ([a-z]+)\b", text, re.MULTILINE)


def help_of(*words: str) -> str:
    from spacesim.cli import main

    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit), patch.dict(os.environ, COLUMNS=str(WIDTH)):
        main([*words, "--help"])
    return said.getvalue()


if __name__ == "__main__":
    for path, text in pages().items():
        print(f"{path}: {len(text.split())} words")
        if len(sys.argv) > 1:
            place = Path(sys.argv[1]) / path
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(text, encoding="utf-8")
