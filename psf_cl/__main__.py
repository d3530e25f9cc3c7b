"""``python -m psf_cl`` is ``psf-cl``."""

from psf_cl.cli.main import program

if __name__ == "__main__":
    program()
