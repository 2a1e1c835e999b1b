"""How each snippet of the documents is run: the reviewed list. A snippet that no row fits fails the test, so that
nothing new is shown untried.

The first row whose pattern fits a command from its beginning to its end is the one. `{name}` in `instead` is a file
of the folder that `world.py` prepares.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal

from tests.needs import PLOTS, TRAIN, Need

How = Literal["ends", "runs", "help", "slow", "ci", "service", "walk", "elsewhere"]
"""ends: run to its end, exit status 0. runs: run until it printed `says`, then Ctrl-C, no traceback. help: too long to
be run at all; its program knows every option that is named (.ci/run runs benchmarks in short form). slow: as `ends`,
but in .ci/run only. ci: .ci/run has this step, `says` is the line. service: it is how the service of these tests was
started. walk: a test of the page's own types it, in the page's order (TRIED_ELSEWHERE). elsewhere: it changes the
reader's system, or needs a sensor and hands; the test file `says` tries what it installs, or has both.
"""


@dataclass(frozen=True)
class Row:
    pattern: str
    how: How
    says: str = ""  # regular expression that the output must hold
    instead: str = ""  # what is typed where the document's line names a file or an argument of the reader's own
    code: int = 0
    needs: Need | None = None


TOUCHED = "./skin press --x 0.02 --y -0.01 --force 3"

COMMANDS = (
    # starting, testing
    Row("make up", "slow", says="contacts at"),
    Row("make test", "ci", says="make test"),
    Row("make lint", "ci", says="make test"),  # which begins with it
    Row("make site", "ci", says="make site"),
    Row("make lock", "ends", says="uv pip compile", instead="make -n lock"),
    Row("make train", "ends", says="models.build", instead="make -n train"),
    Row("skin --version", "ends", says="^eitskin [0-9]"),
    Row(r"\.venv/bin/python -m pytest tests/protocol", "ci", says="make test"),
    Row(r"\.venv/bin/python -m pytest -m release -s tests/cli/test_calibrate_live.py.*", "ci", says="make check-all"),
    Row(
        r"\.venv/bin/python docs/pictures\.py ADDRESS",
        "ends",
        instead='.venv/bin/python -m py_compile docs/pictures.py',
        needs=PLOTS,
    ),
    Row("cp docs/systemd/.*|systemctl .*|journalctl .*", "elsewhere", says="tests/docs/test_systemd.py"),
    Row(r"pip install (eitskin|\.)", "elsewhere", says="tests/protocol/test_client_wheel.py"),
    Row("make venv-dev", "ci", says="make test"),  # its first prerequisite
    Row("make venv-dev EXTRAS=plots,peers", "ci", says="make venv-dev EXTRAS=train,plots,peers"),
    Row("make venv(-dev)? EXTRAS=(train|plots|peers)", "ci", says="make venv-dev EXTRAS=train,plots,peers"),
    Row("make test EXTRAS=train,plots,peers", "ci", says="make venv-dev EXTRAS=train,plots,peers"),
    Row("make venv EXTRAS=train,plots,peers", "ci", says="make venv-dev EXTRAS=train,plots,peers"),
    Row("make test-all", "ci", says="make check-all"),
    Row("make search", "ends", says="hypothesis", instead="make -n search"),
    Row("make venv", "ci", says="make up"),  # whose first prerequisite it is
    Row(
        "(./)?skin bridge page",
        "runs",
        says="look at the skin, and press it, at http://127.0.0.1:",
        instead="EITSKIN_RUNTIME={folder}/page ./skin bridge page",  # beside the one of the service of these tests
    ),
    Row(
        # my-skin is trained so, as docs/your-skin.md says
        "make train SKIN=square16 QUICK=1",
        "ends",
        says="models.build --skin square16 --quick",
        instead="make -n train SKIN=square16 QUICK=1",
    ),
    Row("(./)?skin up", "service"),
    Row("(./)?skin up --no-board", "ends", says="--no-board", instead="./skin up --help"),
    Row(
        "export EITSKIN_UID=.*",
        "ends",
        says="^[0-9]+ [0-9]+ /tmp/",
        instead="{line} && echo $EITSKIN_UID $EITSKIN_GID $EITSKIN_RUNTIME",
    ),
    Row("make ros-venv", "ends", says="rclpy", instead="make -n -B ros-venv"),
    Row(r"make venv EXTRAS=(ros2|foxglove)", "ci", says="make venv-dev EXTRAS=.*,ros2,foxglove"),
    Row(r"docker compose --profile (ros2|foxglove) up", "ci", says=r"--profile ros2 --profile foxglove up"),
    Row(
        "docker compose --profile demo --profile page up",
        "ci",
        says=r"docker compose -f \$compose --profile demo --profile page",
    ),
    Row("docker compose --profile demo up", "ci", says=r"docker compose -f \$compose --profile demo"),
    Row("docker compose up", "ci", says=r"docker compose -f \$compose --profile demo"),
    # pressing, watching
    Row(re.escape(TOUCHED), "ends", says="pressing at .* with 3 N for 20 s"),
    Row("(./)?skin press", "ends", says="pressing at", instead=TOUCHED),
    Row(
        "(./)?skin compare( --seconds (5|300))?",
        "ends",
        says="true touches seen|nothing touched",
        instead="./skin compare --seconds 2",
    ),
    Row(
        "(./)?skin top", "runs", says='"skin": "palm"', instead="./skin top --json"
    ),  # as a picture: test_top_screen.py
    Row("skin top --json", "runs", says='"skin": "palm"', instead="./skin top --json"),
    Row("(./)?skin echo contact", "runs", says="contact/palm scan +[0-9]+ valid"),
    Row("(./)?skin echo judgements", "runs", says="judgements/palm scan +[0-9]+ valid"),
    Row("skin echo TOPIC", "ends", says="raw/palm scan", instead="./skin echo raw -n 2"),
    Row("(./)?skin scene paper_49", "ends", says="playing paper_49"),
    Row("skin scene", "ends", says="paper_49"),
    Row(
        "skin fault NAME key=value --seconds S",
        "ends",
        says="electrode_open electrode=3",
        instead="./skin fault electrode_open electrode=3 --seconds 0.1",
    ),
    Row("skin fault", "ends", says="electrode_open"),
    Row("skin release", "ends", says="nothing touches"),
    Row(r"skin tare( --force)?", "ends", says="new baseline from 64 frames"),
    Row("(./)?skin doctor", "ends", says="OK +configuration"),
    Row(
        "python -m firmware_stub",
        "runs",
        says="board of palm at",
        instead="EITSKIN_RUNTIME={folder}/stub .venv/bin/python -m firmware_stub",
    ),
    Row(
        # the process that docs/extending.md adds; any process
        "python -m services.alarm|python -m services.health (alarm|PROCESS)",
        "ends",
        instead=".venv/bin/python -m services.health publisher",
    ),
    Row("skin (up|down|press|top|release|replay|doctor)", "ends", instead="./skin --help"),
    # bridges
    Row(
        r"(\./)?skin bridge ros2",
        "runs",
        says="ros2: publishing /eitskin/palm in ROS domain 97",
        instead="ROS_DOMAIN_ID=97 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ./skin bridge ros2",
    ),
    Row(r"(\./)?skin bridge foxglove", "runs", says="foxglove: open ws://127.0.0.1:", instead="./skin bridge foxglove"),
    Row("skin export", "ends", says="--csv", instead="./skin export --help"),
    Row("skin bridge NAME", "ends", instead="./skin bridge --help"),
    Row(
        r"(\./)?skin export FILE.mcap --rerun",
        "ends",
        says="rerun-sdk|\\.rrd",
        code=0 if find_spec("rerun") else 2,
        instead="./skin export {folder}/demo.mcap --rerun",
    ),
    Row(
        r"(\./)?skin export FILE.mcap --(?P<kind>foxglove|ros2|csv)",
        "ends",
        says="palm|rows [0-9]+",
        instead="./skin record {folder}/export.mcap --seconds 1 --overwrite && "
        "./skin export {folder}/export.mcap --csv --overwrite",
    ),
    Row(
        "skin record FILE.mcap --topics raw,contact,judgements,status,info",
        "ends",
        says="judgements/palm [0-9]+",
        instead="./skin record {folder}/why.mcap --overwrite --seconds 1 --topics raw,contact,judgements,status,info",
    ),
    Row(
        "skin record FILE.mcap --topics raw,contact,image.*",
        "ends",
        says="image/palm [0-9]+",
        instead="./skin record {folder}/all.mcap --overwrite --seconds 1 --topics raw,contact,image,shape,status,info",
    ),
    # recordings, files
    Row(r"\.venv/bin/python node.py", "ends", instead=".venv/bin/python -c 'import msgpack, zmq'"),  # see PROGRAMS
    Row(
        r"(\./)?skin info( touch.mcap)?",
        "ends",
        says="contact/palm +[0-9]+",
        instead="./skin record {folder}/info.mcap --seconds 1 --overwrite && ./skin info {folder}/info.mcap",
    ),
    Row(
        r"\./skin record touch.mcap --seconds 10",
        "ends",
        says="contact/palm [0-9]+",
        instead="./skin record {folder}/touch.mcap --seconds 2",
    ),
    Row(
        r"\./skin replay touch.mcap --private --fast",
        "ends",
        says="contact frames",
        instead="./skin replay {folder}/touch.mcap --private --fast",
    ),
    Row(
        "(./)?skin record touch.mcap --file-mb .*",
        "ends",
        says="contact/palm [0-9]+",
        instead="./skin record {folder}/long.mcap --overwrite --seconds 1 --file-mb 500 --file-minutes 60 --keep 24",
    ),
    Row(
        "(./)?skin record kept --trigger .*",
        "ends",
        says="[0-9]+ snapshots, 0 could not be taken",
        instead="./skin record {folder}/kept --trigger contact --trigger fault --before 10 --after 5 --seconds 1",
    ),
    Row(
        "(./)?skin snapshot.*",
        "ends",
        says="-snapshot.mcap",
        instead='made=$(./skin snapshot --after 0.2 --why "the arm stopped") && echo $made && rm $made',
    ),
    Row(
        "(./)?skin info.*",
        "ends",
        says="raw/palm",
        instead="./skin record {folder}/info.mcap --seconds 1 --overwrite && "
        "./skin info {folder}/info.mcap --png {folder}/info.png",
        needs=PLOTS,
    ),
    Row("(./)?skin golden.*", "ends", says="as accepted", instead="./skin golden tests/recording/golden/faults.mcap"),
    Row("make golden", "ends", says="--accept", instead="make -n golden"),
    Row("skin record", "ends", says="contact/palm [0-9]+", instead="./skin record {folder}/demo.mcap --seconds 2"),
    Row(
        "skin replay",
        "ends",
        says="contact frames",
        instead="./skin replay {folder}/demo.mcap --private --fast",
    ),
    Row(
        "skin import",
        "ends",
        says="frames of 192 measurements",
        instead="./skin import {presses} {folder}/presses.mcap --skin disc16 --overwrite",
    ),
    Row(
        "skin reconstruct IN.npz OUT.npz --skin square16",
        "ends",
        says="2 rows",
        instead="./skin reconstruct {measurements} {folder}/out.npz --skin square16",
    ),
    Row(
        "skin reconstruct",
        "ends",
        says="2 rows",
        instead="./skin reconstruct {measurements} {folder}/out.npz --skin square16",
    ),
    Row(r"(\./)?skin calibrate --live.*", "elsewhere", says="tests/cli/test_calibrate_live.py"),
    Row(
        "(./)?skin calibrate force",
        "ends",
        says="force = ",
        instead="./skin calibrate force --csv {forces} --out {folder}/palm-force.json",
    ),
    Row(
        "(./)?skin register",
        "slow",
        says="wrote",
        instead="./skin register {presses} --skin disc16 --out {folder}/my-skin",
    ),
    # the real skin's block, in its order; FILE is the reference data
    Row(r"\./skin replay presses.mcap .*", "slow", says="1064 of them valid, 500 touched", instead="{line}"),
    Row(r"\./skin reconstruct FILE .*", "slow", says="500 rows, 500 touched, 500 valid", instead="{line}"),
    Row(r"\./skin (register|import) FILE .*", "slow", instead="{line}"),
    Row(r"\.venv/bin/python -m bench.real_presses FILE", "slow", says="skin register", instead="{line} --quick"),
    # examples
    Row(
        r"\.venv/bin/python -m examples\.(stop_on_contact|guarded_move --newtons 2)",
        "runs",
        says="robot (moves|stands)",
    ),
    Row(
        r"\.venv/bin/python -m examples\.reflex",
        "runs",
        says="told to stop after, ms",
    ),
    Row(
        r"\.venv/bin/python -m examples\.follow_the_finger",
        "runs",
        says="robot (moves|stands)",
        instead=f"{TOUCHED} && {{line}}",
    ),
    Row(r"g\+\+ .* -o /tmp/subscribe && /tmp/subscribe palm", "slow", says=r"frame \d+ valid"),
    # keys, in the order of their page
    Row("skin keys new", "ends", says="NAME|name", instead="./skin keys new --help"),
    Row(r"\./skin keys new \w+", "ends", says="public: "),
    Row("mkdir -p keys/.*", "ends"),
    # offline
    Row(r"(\./)?skin limits --scan( --snr 80)?", "ends", says="Lowest floors", instead="./skin limits --scan --snr 80"),
    Row(r"\./skin limits .*", "help"),
    Row("(./)?skin limits", "slow", says="position", instead="./skin limits"),
    Row("skin bench", "ends", says="accuracy"),
    Row(r"\.venv/bin/python -m bench.plots", "slow", says="latency.png", needs=PLOTS),
    Row(r"\.venv/bin/python -m bench.picture", "slow", says="noise 70 dB", needs=PLOTS),
    Row(r"(\./)?skin bench (?P<name>\w+)( .*)?", "help"),
    Row(r"\.venv/bin/python -m bench\.speed\.page", "help"),
    Row(r"\.venv/bin/python -m bench\.registered_network FILE my-skin", "help"),
    Row("python -m models.average", "help", needs=TRAIN),
    Row(r"python -m models.published --minutes 45", "help", needs=TRAIN),
    Row(
        r"\.venv/bin/python -m models.class_temperature",
        "slow",
        says=r"int8: right, all 0.68.*, all 0.03",
        needs=TRAIN,
    ),
    Row(r"(\.venv/bin/)?python -m models.build .*", "help", needs=TRAIN),
    Row("python -m protocol.wire_doc", "ends", instead=".venv/bin/python -m protocol.wire_doc"),
    # docs/your-skin.md, in its order
    Row(r"(\./)?skin new( .*)?", "walk"),
    Row(r"(\./)?skin collect", "ends", says="OUT.npz", instead="./skin collect --help"),
    Row("make train SKIN=(my-skin QUICK=1|my-registered MINUTES=10)", "walk"),
    Row(r"\./skin up --config mine.toml", "walk"),
    Row(r"\./skin (tare|release|echo contact -n 5)", "walk"),
    Row(r"\./skin press --x 0.012 .*", "walk"),
    Row(r"\./skin (collect|calibrate force|register) .*presses.npz.*", "walk"),
)


def row_for(command: str) -> Row | None:
    """The row that says how a command is run; None: nobody has thought of it."""
    return next((row for row in COMMANDS if re.fullmatch(row.pattern, command)), None)


@dataclass(frozen=True)
class Program:
    """A block of Python: the one in `file` that holds `marker`. Run for `seconds` while frames flow, and then still
    running, having printed at least so many lines.
    """

    file: str
    marker: str
    seconds: float
    lines: int


PROGRAMS = (
    Program("README.md", "zmq.Context()", 4.0, 10),
    Program("docs/clients.md", "from eitskin.client import", 3.0, 0),
    Program("protocol/WIRE.md", "zmq.Context()", 4.0, 10),
)

SCENES = (("firmware_stub/README.md", "[[press]]"),)
"""Blocks of TOML that are scenes of the stub: (file, marker)."""

CONFIGS = (("docs/operations.md", "[skins.left-palm]"),)
"""Blocks of TOML that are a whole skin.toml: (file, marker)."""

NOT_RUN = (("protocol/WIRE.md", "01 Hello: "),)
"""Blocks that are nothing to run: (file, how it begins). The link's schema: tests/protocol/test_wire_doc.py has it."""

TRIED_ELSEWHERE = {
    "docs/security.md": "tests/cli/test_security.py",
    "docs/page.md": "tests/bridges/test_page.py",
    "docs/recording.md": "tests/recording/test_snapshots.py",
    "docs/extending.md": "tests/docs/test_extending.py",
    "docs/your-skin.md": "tests/docs/test_your_skin.py",
    "docs/ros.md": "tests/bridges/test_ros_page.py",
    "docs/foxglove.md": "tests/bridges/test_ros_page.py",
}
"""Documents whose blocks a test of their own runs, or applies where they are changes of the code."""
