"""The command line: spt-jax demo, check, untangle, fit, clean, measure and view."""

import sys
from collections.abc import Sequence
from contextlib import suppress

import tyro

from spt_jax.cli.check import check
from spt_jax.cli.clean import clean
from spt_jax.cli.compilation import keep_programs
from spt_jax.cli.demo import demo
from spt_jax.cli.fit import fit
from spt_jax.cli.interrupts import hear_again, is_interruption, leave_at_once, say_interrupted
from spt_jax.cli.measure import measure
from spt_jax.cli.streams import OutputLostError, guarded_streams
from spt_jax.cli.terminal import CommandError
from spt_jax.cli.untangle import untangle
from spt_jax.cli.view import view

_COMMANDS = {
    "demo": demo,
    "check": check,
    "untangle": untangle,
    "fit": fit,
    "clean": clean,
    "measure": measure,
    "view": view,
}


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    0: done. 1: `check` found a self-intersection, `untangle` left one in a mesh, or `fit` could not
    fit somebody or put somebody where no photograph could show them, or a file of a folder could
    not be worked on. 2: the input or the output
    folder is at fault, the output takes no more, or a surface is none that could be measured, said
    in one line on the standard error stream. 130: interrupted. 141: the output is a pipe whose
    reader has gone.

    Args:
        args: the words after `spt-jax`; those of the process if None.
    """
    try:
        with guarded_streams():
            return _run(args)
    except OutputLostError as error:
        if error.closed:
            return 141
        with suppress(OSError):
            print(f"spt-jax: {error}", file=sys.stderr, flush=True)
        return 2


def _run(args: Sequence[str] | None) -> int:
    if args is None:  # a process of its own, whose environment is nobody else's
        keep_programs()
        hear_again()
    try:
        return tyro.extras.subcommand_cli_from_dict(
            _COMMANDS,
            prog="spt-jax",
            description="Self-intersections of meshes and bodies, removed; bodies from keypoints.",
            args=args,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
    except CommandError as error:
        print(f"spt-jax: {error}", file=sys.stderr)
        return 2
    except MemoryError:
        print(
            "spt-jax: there is not enough memory for this; free some, or take a smaller mesh or "
            "fewer frames",
            file=sys.stderr,
        )
        return 2
    except (KeyboardInterrupt, ValueError, RuntimeError) as error:
        if is_interruption(error):
            code = say_interrupted()
            if args is None:
                leave_at_once(code)
            return code
        # Imported here: not every command measures something.
        from spt_jax.overlap.measure import Unmeasurable

        if not isinstance(error, Unmeasurable):
            raise
        print(f"spt-jax: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
