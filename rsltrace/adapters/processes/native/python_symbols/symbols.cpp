// What libraries of ROS want from Python as they are loaded, for programs that have no Python: the
// generators of Python messages, which librcl draws in. Nobody looks at the values. The preloaded
// library needs this one, so that it comes after Python, which has them, in programs with Python.

extern "C" {
__attribute__((visibility("default"))) void *PyExc_RuntimeError = nullptr;
__attribute__((visibility("default"))) void *_Py_TrueStruct = nullptr;
}
