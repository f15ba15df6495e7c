"""Any file: read within limits, unpickled without running a thing, written whole or not at all."""
