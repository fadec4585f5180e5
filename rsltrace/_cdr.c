/* Messages to canonical CDR and back, compiled: what encoder_source.py and decoder_source.py generate
   for usual messages, with the same bytes and values. All that is unusual (a wrong type, a number out
   of range, bytes of the other order) goes to those functions, which also raise the errors: so here a
   failure needs no reason.

   No Python code runs between the first look at a message and its last byte, so that nothing changes
   under our feet. Messages do not nest in themselves: recursion is as deep as their definitions. */

#include "_core.h"

#include <math.h>

enum { HEADER = 4, GUESS_MAX = 1 << 20, COPIED_ONCE = 4096 };
enum { SINGLE, ARRAY, SEQUENCE };

static const uint8_t HEADER_BYTES[HEADER] = {0, 1, 0, 0};

/* Of the stable ABI only since 3.11, but the same in 3.10. */
typedef struct {
  void *buf;
  PyObject *obj;
  Py_ssize_t len, itemsize;
  int readonly, ndim;
  char *format;
  Py_ssize_t *shape, *strides, *suboffsets;
  void *internal;
} View;

extern int PyObject_GetBuffer(PyObject *exporter, View *view, int flags);
extern void PyBuffer_Release(View *view);
enum { WRITABLE = 1, WITH_FORMAT = 4, TO_READ = 0x100 };

/* The beginning of numpy's PyArrayObject_fields, which its macros make part of its ABI. */
typedef struct {
  PyObject_HEAD
  char *data;
  int dimensions;
  Py_ssize_t *shape, *strides;
  PyObject *base, *dtype;
  int flags;
} NumpyArray;

/* PyArray_NewFromDescr, and its place in the table of numpy's C functions. */
typedef PyObject *NewNumpyArray(PyTypeObject *, PyObject *dtype, int, const Py_ssize_t *shape,
                                const Py_ssize_t *strides, void *data, int, PyObject *);
enum { C_CONTIGUOUS = 1, NEW_NUMPY_ARRAY = 94 };

static PyTypeObject *array_type, *numpy_array_type;
static NewNumpyArray *new_numpy_array;
static PyObject *frombytes;

typedef struct Plan Plan;

typedef struct {
  Py_ssize_t offset; /* of the slot in a message */
  Py_ssize_t number; /* of items: of an array all, of a sequence the most */
  Py_ssize_t least;  /* bytes of an item, to limit a count before memory is allocated for it */
  PyObject *made_of; /* dtype of an array of numbers, a sequence of one number, or a nested plan */
  int shape;
  char code; /* of struct, or 's' for a string, 'm' for a message */
  uint8_t size;
} Field;

struct Plan {
  PyObject_HEAD
  PyTypeObject *class;
  allocfunc allocate;
  PyObject *encode, *decode;
  PyObject *check; /* what stands in the slot `_check_fields`; NULL if there is none */
  Py_ssize_t check_offset, guess, count;
  Field *fields;
};

static PyObject **slot_at(PyObject *message, Py_ssize_t offset) {
  return (PyObject **)((char *)message + offset);
}

static int holds_numbers(const Field *field) { return strchr("?csm", field->code) == NULL; }

/* -- writing ------------------------------------------------------------------------------------ */

typedef struct {
  uint8_t *data; /* after the header; alignment counts from there */
  size_t size, capacity;
} Output;

/* Returns where to write that many bytes, after padding; NULL if there is no room: then they are only
   counted. */
static uint8_t *add(Output *out, size_t size, size_t alignment) {
  const size_t padding = -out->size & (alignment - 1), limit = PY_SSIZE_T_MAX - HEADER;
  size_t start = out->size + padding;
  if (start > limit || size > limit - start) start = limit, size = 0; /* no memory has as much */
  if (start + size > out->capacity) {
    out->size = start + size;
    return NULL;
  }
  while (out->size < start) out->data[out->size++] = 0;
  out->size += size;
  return out->data + start;
}

static void write_bytes(Output *out, const void *data, size_t size, size_t alignment) {
  uint8_t *place = add(out, size, alignment);
  if (place != NULL) memcpy(place, data, size);
}

static int write_count(Output *out, Py_ssize_t number) {
  const uint32_t count = (uint32_t)number;
  if (number < 0 || (uint64_t)number > UINT32_MAX) return -1;
  write_bytes(out, &count, 4, 4);
  return 0;
}

static int write_integer(uint8_t *place, const Field *field, PyObject *value) {
  const int is_signed = field->code >= 'a';
  long long number;
  if (!PyLong_CheckExact(value) && !PyLong_Check(value)) return -1;
  if (field->code == 'Q') {
    const unsigned long long large = PyLong_AsUnsignedLongLong(value);
    if (large == (unsigned long long)-1 && PyErr_Occurred()) return -1;
    memcpy(place, &large, 8);
    return 0;
  }
  number = PyLong_AsLongLong(value);
  if (number == -1 && PyErr_Occurred()) return -1;
  if (field->size < 8) {
    const long long limit = 1LL << (8 * field->size - is_signed);
    if (number >= limit || number < (is_signed ? -limit : 0)) return -1;
  }
  switch (field->size) {
    case 1: *place = (uint8_t)number; break;
    case 2: memcpy(place, &number, 2); break;
    case 4: memcpy(place, &number, 4); break;
    default: memcpy(place, &number, 8);
  }
  return 0;
}

static int write_float(uint8_t *place, const Field *field, PyObject *value) {
  double number;
  float half;
  if (!PyFloat_CheckExact(value) && !PyFloat_Check(value)) return -1;
  number = PyFloat_AsDouble(value);
  if (field->code == 'd') {
    memcpy(place, &number, 8);
    return 0;
  }
  half = (float)number;
  if (isinf(half) && !isinf(number)) return -1;
  if (isnan(number)) {
    uint64_t whole;
    memcpy(&whole, &number, 8);
    if (!(whole >> 51 & 1)) return -1; /* signaling: the conversion would change it */
  }
  memcpy(place, &half, 4);
  return 0;
}

static int write_text(Output *out, PyObject *value) {
  Py_ssize_t size;
  const char *text;
  if (!PyUnicode_CheckExact(value) && !PyUnicode_Check(value)) return -1;
  text = PyUnicode_AsUTF8AndSize(value, &size);
  if (text == NULL || memchr(text, 0, size) != NULL || write_count(out, size + 1) < 0) return -1;
  write_bytes(out, text, size + 1, 1);
  return 0;
}

static int write_message(Output *out, const Plan *plan, PyObject *message);

static int write_item(Output *out, const Field *field, PyObject *value) {
  uint8_t none[8], *place;
  if (field->code == 's') return write_text(out, value);
  if (field->code == 'm') return write_message(out, (Plan *)field->made_of, value);
  place = add(out, field->size, field->size);
  if (place == NULL) place = none;
  switch (field->code) {
    case 'd':
    case 'f': return write_float(place, field, value);
    case '?':
      *place = value == Py_True;
      return value == Py_True || value == Py_False ? 0 : -1;
    case 'c':
      if (!PyBytes_CheckExact(value) || PyBytes_Size(value) != 1) return -1;
      *place = (uint8_t)*PyBytes_AsString(value);
      return 0;
    default: return write_integer(place, field, value);
  }
}

static int write_list(Output *out, const Field *field, PyObject *values) {
  const int is_list = PyList_CheckExact(values);
  Py_ssize_t count;
  if (!is_list && !PyTuple_CheckExact(values)) return -1;
  count = is_list ? PyList_Size(values) : PyTuple_Size(values);
  if (field->shape == ARRAY ? count != field->number
                            : count > field->number || write_count(out, count) < 0)
    return -1;
  for (Py_ssize_t i = 0; i < count; ++i)
    if (write_item(out, field, is_list ? PyList_GetItem(values, i) : PyTuple_GetItem(values, i)) < 0)
      return -1;
  return 0;
}

static int write_numpy_array(Output *out, const Field *field, PyObject *value) {
  const NumpyArray *array = (NumpyArray *)value;
  if (Py_TYPE(value) != numpy_array_type || array->dimensions != 1 ||
      array->dtype != field->made_of || array->shape[0] != field->number ||
      !(array->flags & C_CONTIGUOUS))
    return -1;
  write_bytes(out, array->data, field->number * field->size, field->size);
  return 0;
}

static int write_array(Output *out, const Field *field, PyObject *value) {
  View view;
  int done = -1;
  if (Py_TYPE(value) != array_type || PyObject_GetBuffer(value, &view, WITH_FORMAT) < 0) return -1;
  if (view.format != NULL && view.format[0] == field->code && view.format[1] == 0 &&
      view.itemsize == field->size && view.len / field->size <= field->number)
    done = write_count(out, view.len / field->size);
  /* No padding follows the count of an empty sequence. */
  if (done == 0 && view.len > 0) write_bytes(out, view.buf, view.len, field->size);
  PyBuffer_Release(&view);
  return done;
}

static int write_message(Output *out, const Plan *plan, PyObject *message) {
  if (Py_TYPE(message) != plan->class) return -1;
  if (plan->count == 0) write_bytes(out, "", 1, 1); /* CDR has no empty structs */
  for (const Field *field = plan->fields; field < plan->fields + plan->count; ++field) {
    PyObject *value = *slot_at(message, field->offset);
    if (value == NULL) return -1;
    if ((field->shape == SINGLE        ? write_item
         : !holds_numbers(field)       ? write_list
         : field->shape == ARRAY       ? write_numpy_array
                                       : write_array)(out, field, value) < 0)
      return -1;
  }
  return 0;
}

/* Writes into as many bytes as the last message of the class took. If there are more, they are counted
   and all is written anew, which copies a large array once only. */
static PyObject *plan_serialize(Plan *plan, PyObject *message) {
  size_t capacity = plan->guess;
  for (;;) {
    PyObject *bytes = PyBytes_FromStringAndSize(NULL, capacity + HEADER);
    char *data = bytes == NULL ? NULL : PyBytes_AsString(bytes);
    Output out = {(uint8_t *)data + HEADER, 0, capacity};
    if (bytes == NULL || write_message(&out, plan, message) < 0) {
      PyErr_Clear();
      Py_XDECREF(bytes);
      return PyObject_CallFunctionObjArgs(plan->encode, message, NULL);
    }
    plan->guess = out.size < GUESS_MAX ? (Py_ssize_t)out.size : GUESS_MAX;
    memcpy(data, HEADER_BYTES, HEADER);
    if (out.size == capacity) return bytes;
    if (out.size < capacity) {
      PyObject *shorter = PyBytes_FromStringAndSize(data, out.size + HEADER);
      Py_DECREF(bytes);
      return shorter;
    }
    Py_DECREF(bytes);
    capacity = out.size;
  }
}

/* -- reading ------------------------------------------------------------------------------------ */

typedef struct {
  const uint8_t *data; /* after the header */
  size_t position, end;
} Input;

/* Returns where that many bytes are, after padding; NULL if they are not there. */
static const uint8_t *take(Input *in, size_t size, size_t alignment) {
  const size_t padding = -in->position & (alignment - 1), left = in->end - in->position;
  const uint8_t *place = in->data + in->position + padding;
  if (padding > left || size > left - padding) return NULL;
  in->position += padding + size;
  return place;
}

/* Returns the count of a sequence or string; -1 if what is left cannot hold as many. */
static Py_ssize_t read_count(Input *in, Py_ssize_t least) {
  const uint8_t *place = take(in, 4, 4);
  uint32_t count;
  if (place == NULL) return -1;
  memcpy(&count, place, 4);
  return count > (in->end - in->position) / (size_t)least ? -1 : (Py_ssize_t)count;
}

static PyObject *read_text(Input *in) {
  const Py_ssize_t size = read_count(in, 1);
  const uint8_t *text = size < 0 ? NULL : take(in, size, 1);
  if (text == NULL) return NULL;
  if (size == 0) return PyUnicode_FromStringAndSize("", 0);
  if (memchr(text, 0, size) != text + size - 1) return NULL;
  return PyUnicode_DecodeUTF8((const char *)text, size - 1, NULL);
}

static PyObject *read_message(Input *in, const Plan *plan);

/* NaNs that the conversion to double would change. */
static int is_signaling(uint32_t bits) {
  return (bits & 0x7FC00000) == 0x7F800000 && (bits & 0x3FFFFF) != 0;
}

#define NUMBER(TYPE, MAKE)               \
  {                                      \
    TYPE value;                          \
    memcpy(&value, place, sizeof value); \
    return MAKE(value);                  \
  }

static PyObject *read_item(Input *in, const Field *field) {
  const uint8_t *place;
  if (field->code == 's') return read_text(in);
  if (field->code == 'm') return read_message(in, (Plan *)field->made_of);
  place = take(in, field->size, field->size);
  if (place == NULL) return NULL;
  switch (field->code) {
    case '?': return PyBool_FromLong(*place);
    case 'c': return PyBytes_FromStringAndSize((const char *)place, 1);
    case 'b': return PyLong_FromLong((int8_t)*place);
    case 'B': return PyLong_FromLong(*place);
    case 'h': NUMBER(int16_t, PyLong_FromLong)
    case 'H': NUMBER(uint16_t, PyLong_FromLong)
    case 'i': NUMBER(int32_t, PyLong_FromLong)
    case 'I': NUMBER(uint32_t, PyLong_FromLongLong)
    case 'q': NUMBER(int64_t, PyLong_FromLongLong)
    case 'Q': NUMBER(uint64_t, PyLong_FromUnsignedLongLong)
    case 'd': NUMBER(double, PyFloat_FromDouble)
    default: {
      uint32_t bits;
      float value;
      memcpy(&bits, place, 4);
      memcpy(&value, place, 4);
      return is_signaling(bits) ? NULL : PyFloat_FromDouble(value);
    }
  }
}

static PyObject *read_list(Input *in, const Field *field) {
  const Py_ssize_t count = field->shape == ARRAY ? field->number : read_count(in, field->least);
  PyObject *values = count < 0 ? NULL : PyList_New(count);
  for (Py_ssize_t i = 0; values != NULL && i < count; ++i) {
    PyObject *value = read_item(in, field);
    if (value == NULL || PyList_SetItem(values, i, value) < 0) Py_CLEAR(values);
  }
  return values;
}

static PyObject *make_numpy_array(const Field *field) {
  Py_INCREF(field->made_of); /* for the call to steal */
  return new_numpy_array(numpy_array_type, field->made_of, 1, &field->number, NULL, NULL, 0, NULL);
}

static PyObject *read_numpy_array(Input *in, const Field *field) {
  const Py_ssize_t bytes = field->number * field->size;
  const uint8_t *place = take(in, bytes, field->size);
  PyObject *made = place == NULL ? NULL : make_numpy_array(field);
  if (made != NULL) memcpy(((NumpyArray *)made)->data, place, bytes);
  return made;
}

/* A large array is extended by its bytes. Else it is made in its size first, which takes fewer steps
   but writes it twice. */
static int fill_array(PyObject *made, const uint8_t *data, Py_ssize_t bytes) {
  if (bytes < COPIED_ONCE) {
    View view;
    int done;
    if (PyObject_GetBuffer(made, &view, WRITABLE) < 0) return -1;
    done = view.len == bytes ? 0 : -1;
    if (done == 0) memcpy(view.buf, data, bytes);
    PyBuffer_Release(&view);
    return done;
  }
  PyObject *source = PyMemoryView_FromMemory((char *)data, bytes, TO_READ);
  if (source == NULL) return -1;
  const int result = done(PyObject_CallMethodObjArgs(made, frombytes, source, NULL));
  Py_DECREF(source);
  return result;
}

static PyObject *read_array(Input *in, const Field *field) {
  const Py_ssize_t count = read_count(in, field->size), bytes = count * field->size;
  const uint8_t *place = count <= 0 ? NULL : take(in, bytes, field->size);
  PyObject *made;
  if (count < 0 || (count > 0 && place == NULL)) return NULL;
  made = PySequence_Repeat(field->made_of, bytes < COPIED_ONCE ? count : 0);
  if (made != NULL && count > 0 && fill_array(made, place, bytes) < 0) Py_CLEAR(made);
  return made;
}

static PyObject *read_message(Input *in, const Plan *plan) {
  PyObject *message;
  if (plan->count == 0 && take(in, 1, 1) == NULL) return NULL;
  message = plan->allocate(plan->class, 0);
  if (message == NULL) return NULL;
  if (plan->check != NULL) *slot_at(message, plan->check_offset) = Py_NewRef(plan->check);
  for (const Field *field = plan->fields; field < plan->fields + plan->count; ++field) {
    PyObject *value = (field->shape == SINGLE  ? read_item
                       : !holds_numbers(field) ? read_list
                       : field->shape == ARRAY ? read_numpy_array
                                               : read_array)(in, field);
    if (value == NULL) {
      Py_DECREF(message);
      return NULL;
    }
    *slot_at(message, field->offset) = value;
  }
  return message;
}

static PyObject *plan_deserialize(Plan *plan, PyObject *raw) {
  if (PyBytes_CheckExact(raw) && PyBytes_Size(raw) >= HEADER) {
    const uint8_t *data = (uint8_t *)PyBytes_AsString(raw);
    Input in = {data + HEADER, 0, (size_t)PyBytes_Size(raw) - HEADER};
    if (memcmp(data, HEADER_BYTES, HEADER) == 0) {
      PyObject *message = read_message(&in, plan);
      if (message != NULL && (in.position == in.end || ((in.position + 3) & ~(size_t)3) == in.end))
        return message;
      PyErr_Clear();
      Py_XDECREF(message);
    }
  }
  return PyObject_CallFunctionObjArgs(plan->decode, raw, NULL);
}

/* -- plans -------------------------------------------------------------------------------------- */

/* Returns where the objects of a class have a slot; -1 with an error if that cannot be seen. Its
   descriptor knows the offset but does not tell: a slot is where a new object has what was put in. */
static Py_ssize_t slot_offset(const Plan *plan, PyObject *name) {
  PyObject *size = PyObject_GetAttrString((PyObject *)plan->class, "__basicsize__");
  const Py_ssize_t end = size == NULL ? -1 : PyLong_AsSsize_t(size);
  PyObject *probe = end < 0 ? NULL : plan->allocate(plan->class, 0);
  PyObject *mark = probe == NULL ? NULL : PyList_New(0);
  Py_ssize_t offset = -1;
  if (mark != NULL && PyObject_GenericSetAttr(probe, name, mark) == 0) {
    for (offset = sizeof(PyObject); offset < end; offset += sizeof(PyObject *))
      if (*slot_at(probe, offset) == mark) break;
    if (offset >= end) {
      offset = -1;
      PyErr_Format(PyExc_TypeError, "%R has no slot %R", plan->class, name);
    }
  }
  Py_XDECREF(size);
  Py_XDECREF(probe);
  Py_XDECREF(mark);
  return offset;
}

/* At the first plan: not all who import this module need numpy. */
static int find_types(void) {
  PyObject *table;
  if (new_numpy_array != NULL) return 0;
  array_type = (PyTypeObject *)attribute_of("array", "array");
  numpy_array_type = (PyTypeObject *)attribute_of("numpy", "ndarray");
  frombytes = PyUnicode_InternFromString("frombytes");
  if (array_type == NULL || numpy_array_type == NULL || frombytes == NULL) return -1;
  table = attribute_of("numpy._core._multiarray_umath", "_ARRAY_API");
  if (table == NULL) { /* numpy 1 */
    PyErr_Clear();
    table = attribute_of("numpy.core._multiarray_umath", "_ARRAY_API");
  }
  if (table != NULL) {
    void **functions = PyCapsule_GetPointer(table, NULL);
    if (functions != NULL) new_numpy_array = (NewNumpyArray *)functions[NEW_NUMPY_ARRAY];
    Py_DECREF(table);
  }
  return new_numpy_array == NULL ? -1 : 0;
}

static int is_as_numpy_makes_it(const Field *field) {
  PyObject *made = make_numpy_array(field);
  const NumpyArray *array = (NumpyArray *)made;
  const int as_declared = made != NULL && Py_TYPE(made) == numpy_array_type &&
                          array->dimensions == 1 && array->shape[0] == field->number &&
                          array->strides[0] == field->size && array->dtype == field->made_of &&
                          (array->flags & C_CONTIGUOUS);
  Py_XDECREF(made);
  return as_declared;
}

static PyTypeObject *plan_type;

static int read_field(Plan *plan, Field *field, PyObject *described) {
  PyObject *slot, *made_of;
  int code, size;
  if (!PyArg_ParseTuple(described, "UCiinnO", &slot, &code, &size, &field->shape, &field->number,
                        &field->least, &made_of))
    return -1;
  field->made_of = Py_NewRef(made_of);
  field->code = (char)code;
  field->size = (uint8_t)size;
  field->offset = slot_offset(plan, slot);
  if (field->offset < 0) return -1;
  if (field->least > 0 && size > 0 && field->number >= 0 &&
      field->number <= PY_SSIZE_T_MAX / 8 && strchr("?cbBhHiIqQfdsm", code) != NULL &&
      (code != 'm' || Py_TYPE(made_of) == plan_type) &&
      (field->shape == SINGLE || !holds_numbers(field) ||
       (field->shape == ARRAY ? is_as_numpy_makes_it(field) : Py_TYPE(made_of) == array_type)))
    return 0;
  if (PyErr_Occurred()) return -1;
  PyErr_Format(PyExc_TypeError, "no such field: %R", described);
  return -1;
}

static PyObject *plan_new(PyTypeObject *type, PyObject *args, PyObject *Py_UNUSED(named)) {
  PyObject *class, *check, *fields, *encode, *decode;
  Py_ssize_t count;
  Plan *plan;
  if (!PyArg_ParseTuple(args, "O!OO!OO", &PyType_Type, &class, &check, &PyTuple_Type, &fields,
                        &encode, &decode) ||
      find_types() < 0)
    return NULL;
  plan = (Plan *)PyType_GenericAlloc(type, 0);
  if (plan == NULL) return NULL;
  plan->class = (PyTypeObject *)Py_NewRef(class);
  plan->allocate = (allocfunc)PyType_GetSlot(plan->class, Py_tp_alloc);
  plan->encode = Py_NewRef(encode);
  plan->decode = Py_NewRef(decode);
  if (check != Py_None) {
    PyObject *name = PyUnicode_FromString("_check_fields");
    plan->check = Py_NewRef(check);
    plan->check_offset = name == NULL ? -1 : slot_offset(plan, name);
    Py_XDECREF(name);
    if (plan->check_offset < 0) goto failed;
  }
  count = PyTuple_Size(fields);
  plan->fields = PyMem_Calloc(count + 1, sizeof *plan->fields);
  if (plan->fields == NULL) {
    PyErr_NoMemory();
    goto failed;
  }
  for (; plan->count < count; ++plan->count)
    if (read_field(plan, plan->fields + plan->count, PyTuple_GetItem(fields, plan->count)) < 0) {
      ++plan->count; /* what it has got is to be released */
      goto failed;
    }
  return (PyObject *)plan;
failed:
  Py_DECREF(plan);
  return NULL;
}

static void plan_dealloc(Plan *plan) {
  PyTypeObject *type = Py_TYPE(plan);
  for (Py_ssize_t i = 0; i < plan->count; ++i) Py_XDECREF(plan->fields[i].made_of);
  PyMem_Free(plan->fields);
  Py_XDECREF(plan->class);
  Py_XDECREF(plan->check);
  Py_XDECREF(plan->encode);
  Py_XDECREF(plan->decode);
  PyObject_Free(plan);
  Py_DECREF(type);
}

static PyMethodDef plan_methods[] = {
    {"serialize", (PyCFunction)plan_serialize, METH_O, NULL},
    {"deserialize", (PyCFunction)plan_deserialize, METH_O, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot plan_slots[] = {
    {Py_tp_new, plan_new},
    {Py_tp_dealloc, plan_dealloc},
    {Py_tp_methods, plan_methods},
    {0, NULL},
};

static PyType_Spec plan_spec = {
    "rsltrace._core.MessagePlan", sizeof(Plan), 0, Py_TPFLAGS_DEFAULT, plan_slots,
};

int add_message_plan(PyObject *module) {
  plan_type = (PyTypeObject *)PyType_FromSpec(&plan_spec);
  return plan_type == NULL ? -1 : PyModule_AddType(module, plan_type);
}
