"""`splatbot doctor`."""

from __future__ import annotations

import os
import sys


def doctor() -> int:
    """Check this installation and print how to fix it.

    The checks cover Python, the libraries, the compiled kernels (against a float64 reference), rendering without a
    display and serial ports. The exit code is 1 if a required part is broken.

    Examples:
        splatbot doctor
        SPLATBOT_ISA=v2 splatbot doctor
    """
    from splatbot.cli.checks import all_checks

    colours = {"ok": "32", "warn": "33", "fail": "31"} if sys.stdout.isatty() and not os.environ.get("NO_COLOR") else {}
    broken = False
    for check in all_checks():
        for finding in check():
            state = f"{finding.state:<4}"
            shown = f"\033[{colours[finding.state]}m{state}\033[0m" if colours else state
            print(f"{shown}  {finding.what}: {finding.detail}", flush=True)
            if finding.fix:
                print(f"      fix: {finding.fix}", flush=True)
            broken |= finding.state == "fail"
    return int(broken)
