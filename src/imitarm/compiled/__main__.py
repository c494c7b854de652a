"""``python -m imitarm.compiled``: build the library of compiled code."""

from imitarm.compiled.kernels import build

if __name__ == "__main__":
    print(build())  # noqa: T201
