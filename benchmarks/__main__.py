"""`python -m benchmarks`: us and every peer on the same meshes, with a gate against a baseline."""

import tyro

from benchmarks.suite import Settings, main

if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
