"""A plotter that draws without a display: pyvista's, or our own where no OpenGL can be had."""

import ctypes
import functools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

_WINDOW_VARIABLE = "VTK_DEFAULT_OPENGL_WINDOW"
_EGL = "vtkEGLRenderWindow"
#: In place of a window: `software.py` draws.
SOFTWARE = "software"
_OSMESA_NAMES = ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")


def import_extra(name: str) -> ModuleType:
    """Return a module of the `viz` extra.

    Raises:
        ImportError: it is not installed, or does not load; the message names the extra.
    """
    try:
        return __import__(name)
    except ImportError as error:
        raise ImportError(
            f'pictures need {name}: got "{error}"; run: pip install "spt-jax[viz]"'
        ) from error


@contextmanager
def offscreen_plotter(width: int, height: int) -> Iterator[Any]:
    """Yield an empty, unlit `pyvista.Plotter` of so many pixels, closed afterwards.

    Or a `SoftwarePlotter`, which takes the same calls, where the system draws nothing.

    Raises:
        ImportError: pyvista is not installed.
    """
    pyvista = import_extra("pyvista")
    window = offscreen_window()
    if window == SOFTWARE:
        from spt_jax.show.software import SoftwarePlotter

        plotter: Any = SoftwarePlotter(width, height)
    else:
        with _window(window), _quiet_vtk():
            plotter = pyvista.Plotter(off_screen=True, window_size=(width, height), lighting="none")
    try:
        yield plotter
    finally:
        plotter.close()


@functools.cache
def offscreen_window() -> str | None:
    """Return the VTK window class that can draw off screen here, None for the system's own.

    VTK 9.7 falls back from one class to the next by itself, but ends at OSMesa without asking
    whether its library is there, and the first drawing then ends the process with a segmentation
    fault. So each class is made once here, undrawn, to see what VTK turns it into. `SOFTWARE` where
    none can.
    """
    if sys.platform != "linux":
        return None
    # EGL before X even where there is a display: one forwarded over a network is slow and may go.
    names = [os.environ.get(_WINDOW_VARIABLE), _EGL]
    if os.environ.get("DISPLAY"):
        names.append("vtkXOpenGLRenderWindow")
    made = ""
    for name in filter(None, names):
        with _window(name), _quiet_vtk():
            import vtkmodules.vtkRenderingOpenGL2  # registers the window classes  # noqa: F401
            from vtkmodules.vtkRenderingCore import vtkRenderWindow

            made = type(vtkRenderWindow()).__name__
        if made != "vtkOSOpenGLRenderWindow":
            return made
    if any(_loads(name) for name in _OSMESA_NAMES):
        return "vtkOSOpenGLRenderWindow"
    return SOFTWARE


@contextmanager
def _window(name: str | None) -> Iterator[None]:
    # VTK reads the variable whenever it makes a window. Left set, it would also turn a viewer's
    # window on a real display into an invisible one; an empty value ends in a segmentation fault.
    before = os.environ.pop(_WINDOW_VARIABLE, None)
    if name is not None:
        os.environ[_WINDOW_VARIABLE] = name
    try:
        yield
    finally:
        os.environ.pop(_WINDOW_VARIABLE, None)
        if before is not None:
            os.environ[_WINDOW_VARIABLE] = before


@contextmanager
def _quiet_vtk() -> Iterator[None]:
    # Each failed attempt is a warning on the standard error stream ("bad X server connection").
    from vtkmodules.vtkCommonCore import vtkLogger

    before = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        yield
    finally:
        vtkLogger.SetStderrVerbosity(before)


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
