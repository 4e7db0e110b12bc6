"""Public recordings of a real acrobot: downloaded once, checked by their hashes, kept in the user's cache.

Eight CSV files (14 MB) of the double pendulum of the DFKI RIC Underactuated Robotics Lab, which has a motor in each
joint: swing-ups under programmed torque pulses.  BSD-3-Clause, (c) 2022 DFKI RIC Underactuated Robotics Lab.

    python examples/recordings.py --out logs               # the first 5 s of each: most balance upright afterwards
    python examples/recordings.py --out logs --seconds 10  # all of it
"""

import argparse
import functools
import hashlib
import sys
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

COMMIT = "1e8544e67f3da72a51ee52fbbb278e131ce2a43f"
ADDRESS = (
    f"https://raw.githubusercontent.com/dfki-ric-underactuated-lab/double_pendulum/{COMMIT}"
    "/leaderboard/acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/"
)
"""The file experimentNN.csv is experimentNN/trajectory.csv below it."""
HASHES = {
    "experiment01.csv": "e79fbc1f7934c333f89f4aaec3a8ae2449acb99ba3fe3785d2832a02e3e543af",
    "experiment02.csv": "68a0917755f054b286586dc15babf267c2b30491ead5cfd1e9d3bb96734dbba3",
    "experiment03.csv": "4eacb04cda4af93fc99eaced7353ce4c675dc265bc133087d5369d6b5238bdd4",
    "experiment04.csv": "f7533941860c380cd8b5a19359e05ab6fe6bb5e706d5418be7787031fa15e538",
    "experiment05.csv": "117b549ec4efe48b522c1c6812988b2e4fcd1221f8f8bfee62e00a6f33d75a3f",
    "experiment06.csv": "fcadf86d65861df02081e93762a6e19971f95fe6a54c4e59c222369fa4728f90",
    "experiment07.csv": "3c93e05cb72d45534d70b9aefbcb40ddd59ebe25ff1925bab268dab83ce48853",
    "experiment08.csv": "a42c43093cdec9edb2dad3e8324b2405185380cafb09de2971807c1c7a1e2f27",
}
"""SHA-256 of the published files."""
SECONDS = 5.0
"""Seconds of each recording that are used: most of them balance upright afterwards, and show little."""
RETRIES = 3
"""Connections made again after one that broke off."""


class RecordingError(RuntimeError):
    """A recording cannot be had, or is not the published one; the message says what to do."""


def recordings(folder: Path | None = None) -> list[Path]:
    """Paths of the eight files: those in `folder`, or, where that is None, those in the user's cache, downloaded first.

    Raises RecordingError where a file is absent or differs from the published one.
    """
    return downloaded() if folder is None else [_checked(folder / name) for name in HASHES]


def _checked(path: Path) -> Path:
    """The path of a file that is the published one."""
    if not path.is_file():
        raise RecordingError(f"{path}: not there; name a folder that has {', '.join(HASHES)}, or leave out --from")
    if hashlib.sha256(path.read_bytes()).hexdigest() != HASHES[path.name]:
        raise RecordingError(f"{path}: not the published file (its SHA-256 differs); leave out --from to download it")
    return path


def downloaded(address: str = ADDRESS, cache: Path | None = None, retries: int = RETRIES) -> list[Path]:
    """Paths of the files in the cache; those that are not there yet, or are damaged, are downloaded.

    A download that broke off goes on where it stopped, also in a later run.  Raises RecordingError.
    """
    try:
        import pooch
        import requests
    except ImportError:
        raise RecordingError("downloads need pooch: pip install 'nnap-em[examples]', or --from FOLDER") from None
    pooch.get_logger().setLevel("WARNING")
    urls = {name: f"{address}{name.removesuffix('.csv')}/trajectory.csv" for name in HASHES}
    store = pooch.create(
        path=cache or pooch.os_cache("nnap_em") / "dfki_acrobot",
        base_url=address,
        registry={name: f"sha256:{value}" for name, value in HASHES.items()},
        urls=urls,
        retry_if_failed=retries,
    )
    host, out = urlsplit(address).netloc, []
    for name in HASHES:
        try:
            part = Path(store.path) / f"{name}.part"
            out.append(Path(store.fetch(name, downloader=functools.partial(_download, part))))
        except ValueError:
            problem = f"what {host} sends is not the published file (its SHA-256 differs), and is not used"
            raise RecordingError(f"{name}: {problem}; get the file elsewhere, then --from FOLDER") from None
        except requests.HTTPError as error:
            problem = f"{host} answers {error.response.status_code} for {urls[name]}"
            raise RecordingError(f"{name}: {problem}; get the file elsewhere, then --from FOLDER") from None
        except requests.RequestException:
            hint = f"download {urls[name]} and the seven others where there is one, then --from FOLDER"
            raise RecordingError(f"{name}: no connection to {host}; {hint}") from None
    return out


def _download(part: Path, url: str, target: str, _) -> None:
    """Fetch the rest of a file into `part`, which becomes the target once it is whole."""
    import requests

    size = part.stat().st_size if part.exists() else 0
    # packed, a range would be one of the packed bytes
    headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={size}-"} if size else {})
    with requests.get(url, headers=headers, stream=True, timeout=30) as answer:
        if answer.status_code == requests.codes.requested_range_not_satisfiable:
            part.unlink()  # nothing follows what is there: begin again
        answer.raise_for_status()
        with part.open("ab" if answer.status_code == requests.codes.partial_content else "wb") as file:
            for chunk in answer.iter_content(1 << 16):
                file.write(chunk)
    part.replace(target)


def beginning(path: Path, seconds: float = SECONDS) -> tuple[list[str], np.ndarray]:
    """Names of the columns, and the rows up to a time."""
    with path.open() as file:
        names = file.readline().strip().split(",")
        rows = np.loadtxt(file, delimiter=",")
    return names, rows[rows[:, names.index("time")] <= seconds]


def write(path: Path, names: list[str], rows: np.ndarray) -> None:
    """A recording as a CSV file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(names), comments="")


def main() -> int:
    """Write the beginnings of all recordings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--from", dest="folder", type=Path, metavar="FOLDER", help="folder of the published files")
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    try:
        source = recordings(args.folder)
    except RecordingError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for path in source:
        write(args.out / path.name, *beginning(path, args.seconds))
    print(f"wrote {len(source)} files to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
