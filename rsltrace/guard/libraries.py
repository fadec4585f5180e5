"""Which installed packages are libraries, and which are the user's own, installed or not.

Where a package lies does not tell: a colcon workspace and pip put the user's packages into a
``site-packages`` folder, among all others. So libraries are known by name: ROS's own, and those
that many programs use and that are large. Whatever else is installed is taken for the user's.
Installed is what lies in such a folder, or in one of the import path that holds what pip writes of
its packages (``pip install --target``).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache

_SITES = (f"{os.sep}site-packages{os.sep}", f"{os.sep}dist-packages{os.sep}")


def _targets() -> Iterator[str]:
    """Give the folders of the import path that pip installed packages into, by their records."""
    for folder in sys.path:
        path = os.path.join(folder, "")
        with suppress(OSError):
            if (
                os.path.isabs(folder)
                and not path.endswith(_SITES)
                and any(name.endswith(".dist-info") for name in os.listdir(folder))
            ):
                yield path


TARGETS = tuple(_targets())
"""Such folders as the process began with: ``PYTHONPATH``, mostly."""
INSTALLED = (*_SITES, *TARGETS)
"""A path that has one of these in it is of an installed package, be it a library's or not."""
_ROS = f"{os.sep}opt{os.sep}ros{os.sep}"
_INTERFACES = frozenset(("msg", "srv", "action"))

_OF_ROS = (
    "ament_",
    "fastcdr",
    "fastrtps",
    "launch",
    "rcl",
    "rcutils",
    "rmw",
    "ros2",
    "ros_wheels",
    "rosbag2_",
    "rosidl",
    "rpyutils",
    "rqt",
)
_KNOWN = frozenset(
    """
    absl accelerate aiofiles aiohappyeyeballs aiohttp aiosignal altair annotated_types anyio
    apsw argcomplete arrow asgiref ast_serialize astropy asttokens attr attrs autobahn av babel
    backports bleak bokeh boto3 botocore bs4 casadi certifi cffi chardet charset_normalizer
    click cloudpickle colorama colorlog contourpy coverage cryptography cv2 cvxopt cvxpy cycler
    dash dask dateutil debugpy decorator deepdiff dill distributed distro distutils django
    docutils dotenv duckdb ecos evdev exceptiongroup execnet fast_sugiyama fastapi ffmpeg
    filelock filterpy flask flatbuffers fontTools freezegun frozenlist fsspec gevent git google
    greenlet grimp grpc gtsam gym gymnasium h11 h5py httpcore httpx huggingface_hub humanize
    hypothesis idna imageio importlib_metadata importlib_resources iniconfig ipykernel IPython
    isympy jax jaxlib jedi jinja2 joblib jsonpickle jsonschema jsonschema_specifications keras
    keyboard kiwisolver lark librosa librt lightning linkify_it llvmlite loguru lxml lz4
    markdown markdown_it markupsafe matplotlib mcap mcap_ros2 mdit_py_plugins mdurl meshcat
    meshio mock more_itertools mpl_toolkits mpmath msgpack mujoco multidict multiprocess mypy
    mypy_extensions mypyc netifaces networkx nltk nose notebook numba numexpr numpy onnx
    onnxruntime open3d openai OpenGL OpenSSL opentelemetry orjson osqp outcome packaging paho
    pandas paramiko parso patsy pexpect pickleshare PIL pinocchio pip pkg_resources platformdirs
    plotly pluggy polars prompt_toolkit propcache proto psutil psycopg2 ptyprocess pure_eval py
    pyarrow pyasn1 pybullet pycparser pydantic pydantic_core pydantic_settings pygame pyglet
    pygments pylab pymavlink pynput pyparsing pyperf PyQt5 PyQt6 pyrealsense2 PySide2 PySide6
    pytest pytest_asyncio pytest_cov pytest_mock pytest_timeout pytz pyudev pyvista qpsolvers
    quaternion redis referencing regex requests rerun rerun_bindings rerun_cli rich rosbags rpds
    ruamel ruff safetensors scipy scs seaborn serial setuptools shapely shellingham six skimage
    sklearn smbus sniffio socketio sortedcontainers sounddevice soupsieve sqlalchemy sqlite3
    stack_data starlette statsmodels sympy tabulate tenacity tensorboard tensorflow termcolor
    textual textual_serve threadpoolctl tokenizers toml tomli toolz torch torchaudio torchvision
    tornado tqdm traitlets transformers transforms3d trimesh trio triton trustme twisted
    typeguard typer typing_extensions typing_inspection tzdata tzlocal ujson ultralytics urllib3
    usb uvicorn uvloop virtualenv wcwidth websocket websockets werkzeug wheel wrapt xdist Xlib
    xxhash yaml yarl zipp zmq zope zstandard
    cv_bridge image_geometry laser_geometry message_filters osrf_pycommon python_qt_binding
    sensor_msgs_py sros2 tf2_geometry_msgs tf2_kdl tf2_py tf2_ros tf2_sensor_msgs
    tf_transformations urdf_parser_py
    """.split()
)


def is_library(file: str) -> bool:
    """Return whether a source file is of an installed library (or of generated interfaces)."""
    for installed in INSTALLED:
        place = file.rfind(installed)
        if place >= 0:
            parts = file[place + len(installed) :].split(os.sep, 2)
            return (
                _is_known(parts[0])
                or file.startswith(_ROS)
                or (len(parts) == 3 and parts[1] in _INTERFACES)
            )
    return False


@lru_cache(maxsize=4096)
def _is_known(name: str) -> bool:
    name = name.partition(".")[0].lstrip("_")
    return (
        name in _KNOWN or name.startswith(_OF_ROS) or name.startswith(("distutils", "hypothesis"))
    )


__all__ = ["INSTALLED", "TARGETS", "is_library"]
