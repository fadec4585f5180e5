"""Lets user code import interfaces and find shares of packages that nobody has built.

Both are looked for only when somebody asks: most jobs never do, and what looks is loaded then.
What is built comes first.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from rsltrace.adapters.workspace.bundled import BUNDLED, bundled_packages
from rsltrace.errors import SetupError
from rsltrace.guard.guard import engage
from rsltrace.trace.model.module_search import is_beside_package_xml

if TYPE_CHECKING:
    from importlib.metadata import Distribution, DistributionFinder

    from rsltrace.adapters.workspace.interfaces import InterfaceMaker
    from rsltrace.source_packages import SourcePackage

_KINDS = ("msg", "srv", "action")
_SUPPORT = "_s__rosidl_typesupport_c"


class UnbuiltWorkspace:
    """The packages in and below some folders, as far as they have not been built, and those whose
    interfaces are sourced without their Python modules, or bundled with rsltrace."""

    def __init__(self, folders: Sequence[Path], *, native: bool = False) -> None:
        """``native``: their interfaces go to ROS's middleware, which needs them compiled."""
        self._folders = folders
        self._native = native
        self._packages: dict[str, SourcePackage] | None = None
        self._makers: dict[str, InterfaceMaker] | None = None
        self._modules: dict[str, Path] | None = None
        self.made: set[str] = set()
        """Packages whose interfaces somebody has imported."""

    @property
    def packages(self) -> dict[str, SourcePackage]:
        """The packages by name; looked for once."""
        if self._packages is None:
            with engage(None):
                from rsltrace.source_packages import source_packages

                self._packages = source_packages(self._folders)
        return self._packages

    def interfaces(self, name: str) -> InterfaceMaker | None:
        """Return what makes the classes of a package; None if it has none."""
        package = self.packages.get(name)
        is_own = package is not None and bool(package.interfaces)
        with engage(None):
            from rsltrace.source_packages import sourced_package

            sourced = None if is_own else sourced_package(name)
            if name not in BUNDLED and not is_own and sourced is None:
                return None
            from rsltrace.adapters.workspace.interfaces import (
                InterfaceMaker,
                has_rosidl,
                interface_makers,
            )

            if not is_own and not has_rosidl():
                return None  # as where nothing has the package: code may do without it
            if self._makers is None:
                self._makers = interface_makers({**bundled_packages(), **self.packages})
            if sourced is not None and name not in self.made:
                self._makers[name] = InterfaceMaker(sourced, self._makers)
            maker = self._makers.get(name)
            if maker is None:
                return None
            _ = maker.prefix  # which is laid out now
        self.made.add(name)
        return maker

    def made_module(self, package: str, kind: str, module: str) -> Path | None:
        """Return the file of ``package.kind.module``, made if need be; None if there is no such
        interface.

        :raises JobError, SetupError: if it cannot be made.
        """
        maker = self.interfaces(package)
        if maker is None:
            return None
        with engage(None):  # what that takes is none of the node's doing
            for stem in dict.fromkeys(maker.names(kind).values()):
                file = maker.module_of(kind, stem)
                if file.stem == module:
                    maker.make(kind, stem)
                    return file
        return None

    def require_type_support(self, name: str) -> None:
        """Raise SetupError if the interfaces of a package have to be compiled, which is not one
        that was built."""
        if self._native and name in self.made:
            if name in self.packages:
                text = f"{name} in {self.packages[name].folder} has not been built"
                what = "build"
            else:
                text = f"{name} is not installed: there are only its definitions"
                what = "install"
            raise SetupError(
                f"{text}, and its interfaces cannot go over DDS as they are: {what} the package "
                "and source its workspace, or record without --native"
            )

    def shadows(self, name: str) -> bool:
        """Whether a folder of that name could be taken for a package, though it is none."""
        for place in (folder / name for folder in self._folders):
            init = place / "__init__.py"
            if place.is_dir() and (not init.exists() or is_beside_package_xml(str(init))):
                return True
        return False

    def module(self, name: str) -> Path | None:
        """Return the file or folder of a module that a package would install, or None."""
        if self._modules is None:
            with engage(None):
                from rsltrace.adapters.workspace.installs import modules

                listed = [modules(package) for package in self.packages.values()]
            self._modules = {name: path for each in reversed(listed) for name, path in each.items()}
        return self._modules.get(name)

    def executables(self, package: str) -> dict[str, str | Path]:
        """Return the executables of a package: ``module:function`` or a script, by name."""
        found = self.packages.get(package)
        if found is None:
            return {}
        with engage(None):
            from rsltrace.adapters.workspace.installs import executables

            return executables(found)

    def prefix(self, name: str) -> str | None:
        """Return a prefix with the ``share`` of a package, or None if it is none of these."""
        package = self.packages.get(name)
        if package is None:
            return None
        with engage(None):
            from rsltrace.adapters.workspace.installs import share_prefix

            return str(share_prefix(package))


class _InterfaceFinder:
    """Finds ``package.msg`` and its like before anybody takes a folder of sources for it; and the
    modules of a package before anybody takes the folder of its sources for them."""

    def __init__(self, workspace: UnbuiltWorkspace) -> None:
        self._workspace = workspace

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a module that was made of interface files, or None."""
        package, _, rest = name.partition(".")
        if not rest and self._workspace.shadows(name):
            built = PathFinder.find_spec(name)
            if built is not None and (built.origin is None or is_beside_package_xml(built.origin)):
                return _source_spec(self._workspace, name)
            return None
        kind, _, inner = rest.partition(".")
        if inner.startswith("_") and kind in _KINDS and package in self._workspace.made:
            module = self._workspace.made_module(package, kind, inner)
            return None if module is None else _spec(name, module)
        if rest not in _KINDS and rest != package + _SUPPORT:
            return None
        if rest not in _KINDS:
            self._workspace.require_type_support(package)
        built = PathFinder.find_spec(name, path)
        if built is not None and built.origin is not None:
            return None
        maker = self._workspace.interfaces(package)
        if maker is None:
            return None
        folder = maker.modules
        file = folder / rest / "__init__.py" if rest in _KINDS else folder / f"{rest}.py"
        return _spec(name, file) if file.is_file() else None


class _PackageFinder:
    """Finds the modules of packages, and a package that has nothing but interfaces."""

    def __init__(self, workspace: UnbuiltWorkspace) -> None:
        self._workspace = workspace

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a package with interfaces that nobody else has found, or None."""
        if "." in name:
            return None
        found = _source_spec(self._workspace, name)
        if found is not None:
            return found
        maker = self._workspace.interfaces(name)
        return None if maker is None else _spec(name, maker.modules / "__init__.py")

    def find_distributions(
        self, context: DistributionFinder.Context | None = None
    ) -> Iterator[Distribution]:
        """Give what ``importlib.metadata`` is to know of the packages: what is installed comes
        before it."""
        from importlib.metadata import DistributionFinder

        from rsltrace.adapters.workspace.distributions import distributions

        return distributions(self._workspace.packages, context or DistributionFinder.Context())


def _source_spec(workspace: UnbuiltWorkspace, name: str) -> ModuleSpec | None:
    """Return the spec of a module that lies among the sources of a package, or None."""
    place = workspace.module(name)
    if place is None:
        return None
    if place.is_file() or (place / "__init__.py").is_file():
        return _spec(name, place if place.is_file() else place / "__init__.py")
    spec = ModuleSpec(name, None, is_package=True)  # without an __init__.py: a namespace package
    spec.submodule_search_locations = [str(place)]
    return spec


def _spec(name: str, file: Path) -> ModuleSpec | None:
    folder = [str(file.parent)] if file.name == "__init__.py" else None
    return spec_from_file_location(name, file, submodule_search_locations=folder)


_open: list[UnbuiltWorkspace] = []


def made_when_imported(module: str) -> tuple[Callable[[str], Any], list[str]]:
    """Return ``__getattr__`` and ``__all__`` of ``package.msg`` and its like, whose classes are
    made when somebody imports them."""
    package, _, kind = module.partition(".")
    workspace = next(one for one in reversed(_open) if package in one.made)
    maker = workspace.interfaces(package)
    assert maker is not None
    names = maker.names(kind)

    def get(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        with engage(None):  # what that takes is none of the node's doing
            maker.make(kind, *dict.fromkeys(names[one] for one in _wanted(name) if one in names))
        file = maker.module_of(kind, names[name])
        made = import_module(f"{module}.{file.stem}")
        offered = {one: getattr(made, one) for one, stem in names.items() if stem == names[name]}
        vars(sys.modules[module]).update(offered)
        return offered[name]

    return get, sorted(names)


def _wanted(name: str) -> Sequence[str]:
    """Return what else the import statement names for which ``name`` is looked up: rosidl is
    started once for all."""
    frame = sys._getframe(2)
    if frame.f_code.co_name == "_handle_fromlist":
        listed = frame.f_locals.get("fromlist")
        return [str(one) for one in listed] if isinstance(listed, (list, tuple)) else [name]
    return [name]


def unbuilt_executables(package: str) -> dict[str, str | Path]:
    """Return the executables of a package that is used as if it were built, by name."""
    found: dict[str, str | Path] = {}
    for workspace in _open:
        found = found or workspace.executables(package)
    return found


def unbuilt_programs(package: str) -> set[str]:
    """Return the names of what a package would have, were it built: its compiled programs."""
    from rsltrace.adapters.workspace.installs import compiled_executables

    sources = [one.packages[package] for one in _open if package in one.packages]
    return {name for source in sources for name in compiled_executables(source)}


def unbuilt_fault(package: str) -> str:
    """Say what of the build files of a package was not understood; empty if all was."""
    from rsltrace.adapters.workspace.build_files import setup_fault
    from rsltrace.adapters.workspace.installs import unknown_installs

    said = []
    for found in [one.packages[package] for one in _open if package in one.packages][:1]:
        fault = setup_fault(found.folder)
        said += [f"its setup.py, asked without setuptools, failed: {fault}"] if fault else []
        said += unknown_installs(found)[:1]
    return "; ".join(said)


def unbuilt_prefix(package: str) -> Path | None:
    """Return a prefix with the ``share`` of a package that is used as if it were built."""
    prefixes = (workspace.prefix(package) for workspace in _open)
    return next((Path(prefix) for prefix in prefixes if prefix is not None), None)


def unbuilt_names() -> set[str]:
    """Return the names of the packages that are used as if they were built."""
    return {name for workspace in _open for name in workspace.packages}


@contextmanager
def unbuilt_packages(
    folders: Sequence[Path], *, native: bool = False
) -> Iterator[UnbuiltWorkspace]:
    """Let the packages in ``folders`` be used as if they were built, and forget them afterwards.

    Their interfaces are classes without compiled type support: ``native``, creating what needs that
    raises SetupError.
    """
    workspace = UnbuiltWorkspace(folders, native=native)
    before, after = _InterfaceFinder(workspace), _PackageFinder(workspace)
    sys.meta_path.insert(0, before)
    sys.meta_path.append(after)
    _open.append(workspace)
    try:
        with ExitStack() as stack:
            if find_spec("ament_index_python") is not None:
                _put_into_index(stack, workspace)
            yield workspace
    finally:
        _open.remove(workspace)
        sys.meta_path.remove(before)
        sys.meta_path.remove(after)
        for name in [name for name in sys.modules if name.partition(".")[0] in workspace.made]:
            sys.modules.pop(name)


def _put_into_index(stack: ExitStack, workspace: UnbuiltWorkspace) -> None:
    """Let the ament index know the workspace, and the wheels of this Python."""
    from ament_index_python import resources, search_paths

    paths: Callable[[], list[str]] = search_paths.get_search_paths
    resource: Callable[[str, str], tuple[str, str]] = resources.get_resource
    listed: Callable[[str], dict[str, str]] = resources.get_resources

    def get_search_paths() -> list[str]:
        known = paths() if os.environ.get("AMENT_PREFIX_PATH") else []
        with engage(None):
            has_wheels = Path(sys.prefix, "share", "ament_index").is_dir()
        return [*known, sys.prefix] if has_wheels and sys.prefix not in known else known

    def get_resource(resource_type: str, resource_name: str) -> tuple[str, str]:
        try:
            return resource(resource_type, resource_name)
        except LookupError:
            prefix = workspace.prefix(resource_name) if resource_type == "packages" else None
            if prefix is None:
                raise
            return "", prefix

    def get_resources(resource_type: str) -> dict[str, str]:
        found = dict(listed(resource_type))
        if resource_type == "packages":
            for name in workspace.packages.keys() - found.keys():
                found[name] = workspace.prefix(name) or ""
        return found

    for real, ours in (
        (paths, get_search_paths),
        (resource, get_resource),
        (listed, get_resources),
    ):
        _exchange(stack, real, ours)


def _exchange(stack: ExitStack, real: Callable[..., Any], ours: Callable[..., Any]) -> None:
    """Exchange a function of the index in all modules of it that have its name."""
    name = real.__name__
    for key, module in list(sys.modules.items()):
        if not key.startswith("ament_index_python"):
            continue
        if getattr(module, name, None) is real:
            stack.callback(setattr, module, name, real)
            setattr(module, name, ours)
