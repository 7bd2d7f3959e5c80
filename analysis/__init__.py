import os
import sys

if os.path.basename((*sys.argv, "")[0]) in ("landscape", "-m"):  # a program of this package begins, and loads libraries
    from analysis.console.interruption import end_at_once

    end_at_once()
