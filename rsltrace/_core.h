/* What _core.c and _loop.c share. */

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030A0000
#include <Python.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <structmember.h>

/* Headers from 3.12 on do not count this reference: it would be lost in older versions, for which the
   module is built, too. */
#undef Py_RETURN_NONE
#define Py_RETURN_NONE return Py_NewRef(Py_None)

/* Base classes of Python's: what is read here lies in a struct, where Python reads and writes it
   like a slot. A field is NULL until it is set. They have object's __new__, the only one that lets
   Python 3.11 keep the other attributes without a dict. */

typedef struct {
  PyObject_HEAD
  PyObject *now_ns, *events, *activity_ns, *ready;
} Loop; /* what each event needs of it */

typedef struct {
  Loop of_events;
  PyObject *tasks, *idle, *scheduled, *timers, *places, *gate, *min_step_ns;
  PyObject *looks_at, *until_events, *quiet_ns, *interrupt;
} WholeLoop;

typedef struct {
  PyObject_HEAD
  PyObject *handle, *entity, *node, *kind, *cause_event, *cause_output, *input_hash;
  PyObject *flags, *quiet, *busy_ns, *on_end;
} Event;

typedef struct {
  PyObject_HEAD
  PyObject *loop, *event, *entities, *recorder, *unrecorded, *pending, *before, *after;
  PyObject *call_back, *call_back_with;
} Dispatcher;

typedef struct {
  PyObject_HEAD
  /* Not every entity has all of these. */
  PyObject *active, *state, *queue, *keep;
  PyObject *node, *destroyed, *wrapper, *own_group, *mailbox;
  PyObject *callback, *coroutine, *with_info, *deserialize, *serialize, *sites;
  PyObject *dispatcher, *entity_id; /* from here on what a publisher has */
  PyObject *subscriptions, *links, *observers, *count, *channel, *output_kind, *history;
  PyObject *offers, *faults;
} Entity;

typedef struct {
  PyObject_HEAD
  PyObject *due, *running;
} Sites;

typedef struct {
  PyObject_HEAD
  PyObject *heap, *head, *next_ns;
} TimerQueue;

extern PyTypeObject *loop_type, *event_type, *dispatcher_type, *entity_type, *timers_type;
extern PyObject *loop_seen, *event_seen, *dispatcher_seen, *subscription_seen, *timers_seen;
extern PyObject *deque_type;
extern PyCFunction deque_popleft;
extern PyMemberDef loop_fields[], event_fields[], dispatcher_fields[], entity_fields[];

#define FIELD_COUNT(Struct) ((sizeof(Struct) - sizeof(PyObject)) / sizeof(PyObject *))

#define FIELD_PLACE(Struct, field) ((offsetof(Struct, field) - sizeof(PyObject)) / sizeof(PyObject *))

#define OBJECTS(prefix, count)                                                       \
  static int prefix##_traverse(PyObject *self, visitproc visit, void *arg) {         \
    Py_VISIT(Py_TYPE(self));                                                         \
    for (size_t i = 0; i < (count); ++i)                                             \
      Py_VISIT(((PyObject **)(self + 1))[i]);                                        \
    return 0;                                                                        \
  }                                                                                  \
  static int prefix##_clear(PyObject *self) {                                        \
    for (size_t i = 0; i < (count); ++i)                                             \
      Py_CLEAR(((PyObject **)(self + 1))[i]);                                        \
    return 0;                                                                        \
  }                                                                                  \
  static void prefix##_dealloc(PyObject *self) {                                     \
    PyTypeObject *type = Py_TYPE(self);                                              \
    PyObject_GC_UnTrack(self);                                                       \
    prefix##_clear(self);                                                            \
    PyObject_GC_Del(self);                                                           \
    Py_DECREF(type);                                                                 \
  }

#define FIELDS(Struct, prefix, name)                                                 \
  OBJECTS(prefix, FIELD_COUNT(Struct))                                               \
  static PyTypeObject *prefix##_made(PyMemberDef *fields,  PyMethodDef *methods) {   \
    PyType_Slot slots[] = {                                                          \
        {Py_tp_dealloc, prefix##_dealloc}, {Py_tp_traverse, prefix##_traverse},      \
        {Py_tp_clear, prefix##_clear},     {Py_tp_members, fields},                  \
        {Py_tp_methods, methods},          {0, NULL},                                \
    };                                                                               \
    PyType_Spec spec = {                                                             \
        "rsltrace._core." name, sizeof(Struct), 0,                                   \
        Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC, slots,        \
    };                                                                               \
    return (PyTypeObject *)PyType_FromSpec(&spec);                                   \
  }

#define FIELD(Struct, field, name) {name, T_OBJECT_EX, offsetof(Struct, field), 0, NULL}
#define NO_FIELD {NULL, 0, 0, 0, NULL}

/* Whether an object is of a class of ours. ``seen`` is the last of its subclasses that was found to
   be one: to look for a base class takes long. */
static inline int is_a(PyObject *object, PyTypeObject *type, PyObject **seen) {
  PyObject *own = (PyObject *)Py_TYPE(object), *old = *seen;
  if (own == old) return 1;
  if (!PyType_IsSubtype((PyTypeObject *)own, type)) return 0;
  *seen = Py_NewRef(own);
  Py_XDECREF(old);
  return 1;
}

/* Sets the error for an object without the fields of a struct. */
void refuse(PyObject *object, PyTypeObject *type, const PyMemberDef *fields, size_t first);

/* Whether an object has the fields of a struct, all set from ``first`` on; else sets an error. It is
   asked more often than anything else: let the compiler write it out. */
static inline __attribute__((always_inline)) int has_fields(
    PyObject *object, PyTypeObject *type, PyObject **seen, const PyMemberDef *fields,
    size_t first, size_t count) {
  int has = object != NULL && is_a(object, type, seen);
#pragma GCC unroll 16
  for (size_t i = first; i < count; ++i) has = has && ((PyObject **)(object + 1))[i] != NULL;
  if (!has) refuse(object, type, fields, first);
  return has;
}

#define HAS_FIELDS(object, Struct, prefix) \
  has_fields((PyObject *)(object), prefix##_type, &prefix##_seen, prefix##_fields, 0, \
             FIELD_COUNT(Struct))

#define HAS_FIELD(object, Struct, prefix, field) \
  has_fields((PyObject *)(object), prefix##_type, &prefix##_seen, prefix##_fields, \
             FIELD_PLACE(Struct, field), FIELD_PLACE(Struct, field) + 1)

/* Replaces a field by a new object, or fails if there is none. */
int set(PyObject **field, PyObject *value);

/* Reads a number of 64 bits, or sets an error; runs no code of Python. Most have 63: that is faster. */
static inline int read_number(PyObject *value, uint64_t *number) {
  int overflow = 1;
  if (PyLong_CheckExact(value)) *number = (uint64_t)PyLong_AsLongLongAndOverflow(value, &overflow);
  if (!overflow && *number <= INT64_MAX) return 0;
  *number = PyLong_AsUnsignedLongLong(value);
  return *number == UINT64_MAX && PyErr_Occurred() ? -1 : 0;
}

PyObject *attribute_of(const char *module_name, const char *name);
PyObject *call_one(PyObject *callable, PyObject *argument);
PyObject *call_two(PyObject *callable, PyObject *first, PyObject *second);
int done(PyObject *result);
int check_count(const char *name, Py_ssize_t count, Py_ssize_t least, Py_ssize_t most);
int append_to(PyObject *queue, PyObject *item);
int dispatch(PyObject *item);
int record_draw(PyObject *recorder, PyObject *entity, unsigned long long draw);

/* Puts an arrival into the queue of its receiver; returns whether that is ready for it now. */
int queue_arrival(PyObject *receiver, PyObject *arrival);

/* Sends a message over a link: the parts of a delivery from the CDR on. */
int send_over(PyObject *link, PyObject *const *message);

int add_loop_types(PyObject *module);
int add_message_plan(PyObject *module); /* of _cdr.c */
int add_turns(PyObject *module);
