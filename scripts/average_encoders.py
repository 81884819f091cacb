"""Averages the weights of encoders fine-tuned from the same checkpoint.

scripts/run.sh python scripts/average_encoders.py OUT.safetensors FILE.safetensors=SHARE...
"""

import argparse
import sys
from pathlib import Path

from monoforce_ros.encoder import CheckpointError, averaged, save_encoder


def main() -> int:
    parser = argparse.ArgumentParser(description="Average the weights of encoders fine-tuned from the same checkpoint.")
    parser.add_argument("out", type=Path, metavar="OUT.safetensors")
    parser.add_argument(
        "encoders", nargs="+", metavar="FILE=SHARE", help="checkpoint and its weight in the mean (default: 1)"
    )
    options = parser.parse_args()
    paths, shares = [], []
    for text in options.encoders:
        path, given, share = text.rpartition("=")
        paths.append(path if given else text)
        try:
            shares.append(float(share) if given else 1.0)
        except ValueError:
            parser.error(f"{text}: got share {share!r}, expected a number as in {path}=2")
    try:
        save_encoder(averaged(paths, shares), options.out)
    except (CheckpointError, ValueError, OSError) as error:
        print(f"average_encoders: {error}", file=sys.stderr)
        return 1
    print(f"{options.out}: mean of {len(paths)} encoders")
    return 0


if __name__ == "__main__":
    sys.exit(main())
