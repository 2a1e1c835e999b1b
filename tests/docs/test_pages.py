"""What pages name is there: links, places in the code, commands and their options, settings, packages."""

import ast
import re
import shlex
import tomllib
from functools import cache
from pathlib import Path

import protocol
from bench import commands as benchmarks
from firmware_stub import scene
from models import EXTRAS
from services.runtime.config import load
from tests.cli.test_every_command import COMMANDS, HANDED_ON, parameters
from tests.docs.links import anchors, links_of
from tests.docs.snippets import ROOT, documents, snippets

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MAKEFILE = (ROOT / "Makefile").read_text()
PAGES = {str(path.relative_to(ROOT)): path.read_text("utf-8") for path in documents()}
SKIN = '[skins.palm]\nport = "stub"\nbundle = "square16"\n'


def test_links_lead_somewhere_and_every_page_can_be_reached() -> None:
    wrong, leads = [], dict.fromkeys(documents(), frozenset[Path]())
    for link in (link for page in documents() for link in links_of(page)):
        if link.elsewhere:
            wrong += [link] if not link.target.startswith("https://") else []
            continue
        leads[ROOT / link.page] |= {link.path}
        if not link.path.exists() or link.anchor and link.anchor not in anchors(link.path.read_text("utf-8")):
            wrong.append(link)
    assert not wrong
    reached, waiting = set(), [ROOT / "README.md"]
    while waiting:
        if (page := waiting.pop()) not in reached:
            reached.add(page)
            waiting += leads.get(page, ())
    assert reached >= {*documents()}
    navigation = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:\n")[2]
    assert {*re.findall(r": (\S+\.md)$", navigation, re.MULTILINE)} >= {*PAGES}


@cache
def definitions(file: str) -> set[str]:
    """Classes, functions and methods of a file: "Runner", "Runner.run"."""
    found, waiting = set(), [("", ast.parse((ROOT / file).read_text("utf-8")))] if (ROOT / file).is_file() else []
    while waiting:
        before, node = waiting.pop()
        for each in node.body:
            if isinstance(each, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                found.add(before + each.name)
                waiting.append((f"{before}{each.name}.", each))
    return found


def test_files_and_functions_that_pages_name_exist() -> None:
    wrong = []
    for page, text in PAGES.items():
        places = re.findall(r"`([\w/]+\.py):([\w.]+)`", text)
        wrong += [(page, *place) for place in places if place[1] not in definitions(place[0])]
        paths = re.findall(r"`((?:protocol|models|services|firmware_stub|bench|examples|tests)/[\w/.]*)`", text)
        wrong += [(page, path) for path in paths if not (ROOT / path).exists()]
    assert not wrong


def lacks(command: str) -> str:
    """What a command names that there is not; "" where all is there."""
    program, *words = shlex.split(command.replace(".venv/bin/", "").removeprefix("./"))
    options = {word.partition("=")[0] for word in words if word.startswith("--")}
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", MAKEFILE, re.MULTILINE)
        given = [w.split("=") for w in words if "=" in w]
        wrong = [w for w in words if "=" not in w and w not in targets]
        wrong += [name for name, _ in given if f"$({name})" not in MAKEFILE and f"{name} ?=" not in MAKEFILE]
        extras = {extra for name, value in given if name == "EXTRAS" for extra in value.split(",")}
        return " ".join([*wrong, *(extras - PROJECT["optional-dependencies"].keys())])
    if program == "skin" and words[0] not in HANDED_ON:
        name = next((n for n in (" ".join(words[:2]), words[0], f"{words[0]} force") if n in COMMANDS), "")
        known = {option for option, *_ in parameters(COMMANDS[name])} if name else {"--version"}
        return " ".join(sorted(options - known)) or ("" if name or command.endswith("--version") else words[0])
    if program not in ("skin", "python") or words[0] != "-m" and program == "python" or "pytest" in words:
        files = [word for word in words if re.match(r"(docs|examples|tests)/", word)]
        return " ".join(file for file in files if not (ROOT / file).exists())
    module = words[1] if program == "python" else "models.limits"
    if words[0] == "bench":
        module = benchmarks().get((words + ["all"])[1]) or "no.bench"
    file = ROOT / module.replace(".", "/")
    if not (file.with_suffix(".py").is_file() or (file / "__main__.py").is_file() or module == "services.alarm"):
        return words[1]
    text = "".join(path.read_text("utf-8") for path in (ROOT / module.split(".")[0]).rglob("*.py"))
    return " ".join(sorted(option for option in options if f'"{option}"' not in text))


def test_commands_and_options_that_pages_show_exist() -> None:
    """CHANGELOG.md names some that were."""
    shown = [s for s in snippets() if s.kind == "command" and s.file != "CHANGELOG.md"]
    assert not [f"{each}: {wrong}" for each in shown if (wrong := lacks(each.text))]


def test_settings_that_pages_show_are_settings(tmp_path: Path) -> None:
    for each in snippets():
        if each.kind == "toml" and each.file == "firmware_stub/README.md":
            scene.parse(tomllib.loads(each.text))
        elif each.kind == "toml":
            (tmp_path / "skin.toml").write_text(each.text if "[skins." in each.text else f"{each.text}\n{SKIN}")
            named = re.findall(r"^\[skins\.([\w-]+)\]", each.text, re.MULTILINE) or ["palm"]
            assert list(load(tmp_path / "skin.toml").skins) == named, each


def test_the_version_is_the_same_everywhere() -> None:
    newest = re.search(r"^## \[(\d+\.\d+\.\d+)\] - \d{4}-\d\d-\d\d$", PAGES["CHANGELOG.md"], re.MULTILINE)
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert newest[1] == cited[1] == protocol.__version__


def test_an_extra_that_an_error_names_brings_the_package() -> None:
    installed = {"PIL": "pillow", "zenoh": "eclipse-zenoh"}
    for extra, packages in EXTRAS.items():
        lock = (ROOT / "requirements" / f"{extra}.lock").read_text().splitlines()
        brought = [*PROJECT["optional-dependencies"][extra], *lock]
        for name in (installed.get(package, package) for package in packages):
            assert any(line.startswith(f"{name}==") for line in brought), f"{extra} does not bring {name}"


def test_the_unit_s_runtime_folder_is_its_user_s_alone() -> None:
    assert "\nRuntimeDirectoryMode=0700\n" in (ROOT / "docs" / "systemd" / "eitskin.service").read_text()
