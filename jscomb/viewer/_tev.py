"""Images to tev, a viewer that runs beside us, by its protocol."""

import contextlib
import importlib.util

import numpy as np

from jscomb.viewer._scene import Scene

PORT = 14158  # where tev listens


def send_to_tev(scene: Scene, *, host: str = "localhost", port: int = PORT) -> None:
    """Show the images of a scene in a running tev (https://github.com/Tom94/tev).

    Args:
        scene: by `make_scene`; images of the same names are replaced.
        host: where tev runs.
        port: that it listens on.

    Returns:
        nothing.

    Raises:
        ImportError: if the package tevclient is missing.
        ConnectionError: if no tev answers there.

    Example:
        >>> from jscomb.viewer import make_scene
        >>> scene = make_scene("grey", {"a": np.full((2, 2, 3), 0.2)})
        >>> if importlib.util.find_spec("tevclient"):
        ...     try:
        ...         send_to_tev(scene, port=9)
        ...     except ConnectionError as error:
        ...         assert "no tev answers at localhost:9" in str(error)
    """
    if importlib.util.find_spec("tevclient") is None:
        raise ImportError('tev needs its client: pip install "jscomb[tev]"')
    import tevclient  # pyright: ignore[reportMissingImports]

    try:
        with contextlib.ExitStack() as stack:
            tev = tevclient.Ipc(host, port)
            stack.push(tev)  # it leaves its socket open where nobody answers
            tev.__enter__()
            for name, image in scene.images.items():
                height, width, channels = image.shape
                names = ["R", "G", "B"][:channels]
                title = f"{scene.name}/{name}"
                tev.create_image(title, width, height, names)
                tev.update_image(title, np.asarray(image, np.float32), names)
    except OSError as error:
        where = f"no tev answers at {host}:{port}"
        raise ConnectionError(f"{where} ({error.strerror}): start tev first") from None
