"""``python -m psf_cl`` is ``psf-cl``."""

import sys

from psf_cl.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
