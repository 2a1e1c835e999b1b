"""python -m services.stub [options of the stub]: the stub board of every configured skin whose port is "stub".

For a stub in a container of its own, which no `skin up` starts.
"""

from __future__ import annotations

import os
import sys

from services.runtime.config import ROOT, ConfigError, config_path, load
from services.runtime.supervision import stub_arguments


def main() -> int:
    try:
        skins = stub_arguments(load())
    except ConfigError as why:
        print(f"stub: {why}", file=sys.stderr)
        return 1
    if not skins:
        print(f'stub: {config_path()} has no skin with port = "stub": nothing to do', file=sys.stderr)
        return 1
    os.chdir(ROOT)
    os.execv(sys.executable, [sys.executable, "-m", "firmware_stub", *skins, *sys.argv[1:]])


if __name__ == "__main__":
    raise SystemExit(main())
