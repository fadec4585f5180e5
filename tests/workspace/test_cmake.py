"""``CMakeLists.txt`` as far as nothing has to be configured: variables, lists, loops, functions."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.adapters.workspace.cmake import commands
from rsltrace.adapters.workspace.imports import unbuilt_packages
from rsltrace.adapters.workspace.installs import compiled_executables, executables, modules
from rsltrace.errors import JobError
from rsltrace.run.plans.executables import find_executable
from rsltrace.source_packages import SourcePackage

_FILES = (
    "examples/ex_a.py",
    "examples/ex_b.py",
    "tools/c.py",
    "tools/d.py",
    "src/lib/p/__init__.py",
)


@pytest.fixture
def package(tmp_path: Path) -> SourcePackage:
    for name in _FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "package.xml").write_text("<package><name>robot</name></package>")
    return SourcePackage("robot", tmp_path)


def installed(package: SourcePackage, text: str) -> list[str]:
    (package.folder / "CMakeLists.txt").write_text(text)
    return sorted(executables(package))


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (
            "set(EXAMPLES_DIR examples)\ninstall(PROGRAMS ${EXAMPLES_DIR}/ex_a.py\n"
            "  ${EXAMPLES_DIR}/ex_b.py DESTINATION lib/${PROJECT_NAME})",
            "ex_a.py ex_b.py",
        ),
        (
            "project(robot)\nset(A examples/ex_a.py tools/c.py)  # a list )\n"
            'list(APPEND A "tools/d.py")\nLIST(REMOVE_ITEM A tools/c.py)\n'
            "install(PROGRAMS ${A} DESTINATION ${CMAKE_INSTALL_PREFIX}/lib/${PROJECT_NAME})",
            "d.py ex_a.py",
        ),
        (
            'file(GLOB SCRIPTS RELATIVE ${CMAKE_CURRENT_SOURCE_DIR} "examples/*.py")\n'
            'list(FILTER SCRIPTS EXCLUDE REGEX ".*_b\\\\.py$")\n'
            "install(PROGRAMS ${SCRIPTS} DESTINATION lib/robot)",
            "ex_a.py",
        ),
        (
            "foreach(name IN ITEMS a b)\n  foreach(end .py)\n"
            "    install(PROGRAMS examples/ex_${name}${end} DESTINATION lib/robot RENAME ${name})\n"
            "  endforeach()\nendforeach(name)",
            "a b",
        ),
        (
            "set(ALL examples/ex_b.py tools/c.py)\nforeach(file IN LISTS ALL)\n"
            "  get_filename_component(name ${file} NAME_WE)\n"
            "  install(PROGRAMS ${file} RENAME ${name} DESTINATION lib/robot)\nendforeach()",
            "c ex_b",
        ),
        (
            "function(install_tools folder)\n  set(files)\n  foreach(one ${ARGN})\n"
            "    list(APPEND files ${folder}/${one}.py)\n  endforeach()\n"
            "  install(PROGRAMS ${files} DESTINATION lib/${PROJECT_NAME})\nendfunction()\n"
            "install_tools(tools c d)",
            "c.py d.py",
        ),
        (
            "macro(tool FILE)\n install(PROGRAMS tools/${FILE} DESTINATION lib/robot)\nendmacro()\n"
            "if(FALSE)\n tool(c.py)\nelseif(NOT EXISTS ${PROJECT_SOURCE_DIR}/tools)\n tool(c.py)\n"
            "else()\n tool(d.py)\nendif()",
            "d.py",
        ),
        (
            "if(BUILD_TESTING AND UNIX)\n install(PROGRAMS tools/c.py DESTINATION lib/robot)\n"
            "else()\n install(PROGRAMS tools/d.py DESTINATION lib/robot)\nendif()",
            "c.py d.py",
        ),
        (
            "#[[ install(PROGRAMS tools/c.py DESTINATION lib/robot) ]]\n"
            "set(WHERE lib/robot)\nset(SUB_x tools)\nset(k x)\n"
            'install(FILES "${SUB_${k}}/d.py" [[tools/c.py]] PERMISSIONS OWNER_EXECUTE\n'
            "  DESTINATION ${WHERE})",
            "c.py d.py",
        ),
        (
            "string(TOLOWER EXAMPLES dir)\nstring(REPLACE - _ name ex-a.py)\n"
            "install(PROGRAMS ${dir}/${name} DESTINATION lib/robot)",
            "ex_a.py",
        ),
    ],
)
def test_what_is_installed_is_found_as_cmake_would(
    package: SourcePackage, text: str, names: str
) -> None:
    assert installed(package, text) == names.split()


def test_other_files_of_the_package_are_followed(package: SourcePackage) -> None:
    (package.folder / "tools" / "CMakeLists.txt").write_text(
        "install(PROGRAMS c.py DESTINATION ${WHERE})\nset(WHERE nowhere)"
    )
    (package.folder / "more.cmake").write_text("set(FILE ${CMAKE_CURRENT_LIST_DIR}/tools/d.py)")
    text = (
        "set(WHERE lib/robot)\nadd_subdirectory(tools)\ninclude(more.cmake)\n"
        "install(PROGRAMS ${FILE} DESTINATION ${WHERE})"
    )
    assert installed(package, text) == ["c.py", "d.py"]


def test_python_packages_and_programs(package: SourcePackage) -> None:
    (package.folder / "src" / "lib" / "setup.cfg").write_text(
        "[options.entry_points]\nconsole_scripts =\n  go = p.main:go\n"
    )
    text = (
        "set(NAME p)\nset(PYTHON src/lib)\nament_python_install_package(${NAME}\n"
        "  PACKAGE_DIR ${CMAKE_CURRENT_SOURCE_DIR}/${PYTHON}/${NAME}\n"
        "  SETUP_CFG ${PYTHON}/setup.cfg DESTINATION ${PYTHON_INSTALL_DIR})\n"
        "ament_python_install_module(tools/c.py)\n"
        "set(TARGET ${PROJECT_NAME}_node)\nadd_executable(${TARGET} src/main.cpp)\n"
        "rclcpp_components_register_node(x PLUGIN y EXECUTABLE ${TARGET}_2)"
    )
    assert installed(package, text) == ["go"]
    assert modules(package) == {
        "p": package.folder / "src" / "lib" / "p",
        "c": package.folder / "tools" / "c.py",
    }
    assert compiled_executables(package) == {"robot_node", "robot_node_2"}


def test_what_cannot_be_expanded_is_said_with_its_line(package: SourcePackage) -> None:
    text = (
        "find_package(other)\nset(DIR ${other_DIR}/scripts)\n"
        "install(PROGRAMS ${DIR}/go.py tools/c.py DESTINATION lib/robot)"
    )
    assert installed(package, text) == ["c.py"]
    with unbuilt_packages([package.folder]), pytest.raises(JobError) as caught:
        find_executable("robot/go.py", where="job.yaml:1:1")
    assert str(caught.value).endswith(
        "It has c.py; CMakeLists.txt:3: ${other_DIR} is not known before the package is configured"
    )


@given(st.text(alphabet='ab()[]{}$"#\\;= \n<>', max_size=80))
def test_any_text_is_read(text: str) -> None:
    folder = Path(__file__).parent
    package = SourcePackage("robot", folder / "nowhere")
    assert commands(package) == []
    from rsltrace.adapters.workspace import cmake

    evaluation = cmake._CMakeInterpreter(package)
    words, end = cmake._arguments(text, 0)
    assert end <= len(text)
    evaluation._expanded(words)


def test_a_recursion_ends(package: SourcePackage) -> None:
    (package.folder / "CMakeLists.txt").write_text(
        "include(CMakeLists.txt)\nadd_subdirectory(.)\nmacro(m)\n m()\n m()\nendmacro()\nm()"
    )
    assert commands(package) == []


def test_a_value_is_not_expanded_again(package: SourcePackage) -> None:
    """One that refers to itself would grow by powers of ten, as those of rclcpp's flags do."""
    more = 'set(FLAGS "${FLAGS} -a")\n' * 12
    text = f"{more}set(one FLAGS)\ncalled(${{${{one}}}})\ncalled(${{a_${{FLAGS}})"
    (package.folder / "CMakeLists.txt").write_text(text)
    flags = "${FLAGS}" + " -a" * 12
    assert [one.words for one in commands(package)] == [(flags,), (f"${{a_{flags}",)]


_TRIPLED = 'set(a "${a}${a}${a}")\n' * 40


@pytest.mark.parametrize(
    "text",
    [
        _TRIPLED,
        "list(APPEND a ${a} ${a})\n" * 40,
        'string(REPLACE a "${a}" a "${a}")\n' * 40,
        "if(TRUE)\n" * 2000 + "endif()\n" * 2000,
        f"if({'NOT ' * 5000}TRUE)\nendif()\n",
        f'if("{"a" * 40}" MATCHES "(a+)+b")\nendif()\n',
        f'if("{"a" * 40}" MATCHES "{"a?" * 40}{"a" * 40}")\nendif()\n',
        f"set(t {'a' * 300})\n" + 'if(t MATCHES ".*.*.*x")\nendif()\n' * 5000,
        "x([[" * 200_000,
        f"x({'${' * 400_000}",
        f'x("{chr(92) * 999_001}',
        f"list(APPEND a{' b' * 100_000})\nlist(REMOVE_ITEM a{' c' * 100_000})\n",
        "file(GLOB_RECURSE a *)\n" * 20_000,
        f"list(APPEND a{' b' * 9999})\nforeach(i ${{a}})\nif(OFF)\n{'x()' * 99_999}\nendif()\n",
        f"list(APPEND a{' b' * 9999})\nforeach(i ${{a}})\nif(OFF)\n{'elseif(OFF)' * 50_000}\n",
    ],
    ids=[
        *("tripled", "appended", "replaced", "nested", "negated", "matched", "optional"),
        *("stars", "brackets", "braces", "backslashes", "removed", "globs", "skipped", "branches"),
    ],
)
def test_small_files_that_mean_enormous_ones_end(package: SourcePackage, text: str) -> None:
    text = f"set(a aaaaaaaaaaaaaaaaaaaa)\ncalled(first)\n{text}"
    (package.folder / "CMakeLists.txt").write_text(text)
    found = commands(package)
    assert found[0].words == ("first",)


def test_files_outside_the_package_are_not_looked_for(package: SourcePackage) -> None:
    outside = package.folder.parent / "outside.py"
    outside.touch()
    (package.folder / "CMakeLists.txt").write_text(
        f"file(GLOB all ../*.py {outside} tools/../tools/*.py)\ncalled(${{all}})"
    )
    (call,) = commands(package)
    assert [Path(word).name for word in call.words] == ["c.py", "d.py"]
