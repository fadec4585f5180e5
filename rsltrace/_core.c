/* The hot part of a recorded run, compiled: what trace/recorder.py's EventChain and trace/writer.py's
   RecordBuffer do, an event, and the way of a message from its publisher to a callback, with the
   same bytes. What is unusual (a number that does not fit, an index of numpy, a link, a watched
   topic, a coroutine, a busy callback group) is left to Python. */

#include "_core.h"

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "rows are packed as they lie in memory"
#endif

enum {
  REST = 62,        /* format.EVENT_REST */
  REST_OUTPUTS = 56,
  EVENT = 8 + REST, /* behind its chain hash */
  CONTENT = 16,     /* format.OUTPUT_CONTENT */
  CONTENT_KIND = 12,
  DRAW = 11,        /* OutputKind.DRAW */
  TIMER = 2,        /* EventKind.TIMER */
  SUBSCRIPTION = 3, /* EventKind.SUBSCRIPTION */
  HEADER = 31,      /* mcap/records.MESSAGE_HEAD */
  RECORD_HEAD = 9,
  MESSAGE = 5,
  LARGE = 64 << 10, /* mcap/chunk_builder.LARGE_BYTES */
};

#define U32 0xFFFFFFFFu
#define U64 UINT64_MAX

/* -- XXH3-64 of 8 to 64 bytes ------------------------------------------------------------------- */

static const uint8_t SECRET[64] = {
    0xb8, 0xfe, 0x6c, 0x39, 0x23, 0xa4, 0x4b, 0xbe, 0x7c, 0x01, 0x81, 0x2c, 0xf7, 0x21, 0xad, 0x1c,
    0xde, 0xd4, 0x6d, 0xe9, 0x83, 0x90, 0x97, 0xdb, 0x72, 0x40, 0xa4, 0xa4, 0xb7, 0xb3, 0x67, 0x1f,
    0xcb, 0x79, 0xe6, 0x4e, 0xcc, 0xc0, 0xe5, 0x78, 0x82, 0x5a, 0xd0, 0x7d, 0xcc, 0xff, 0x72, 0x21,
    0xb8, 0x08, 0x46, 0x74, 0xf7, 0x43, 0x24, 0x8e, 0xe0, 0x35, 0x90, 0xe6, 0x81, 0x3a, 0x26, 0x4c,
};

static uint64_t at(const uint8_t *data) {
  uint64_t value;
  memcpy(&value, data, sizeof value);
  return value;
}

static uint64_t folded(uint64_t a, uint64_t b) {
  const unsigned __int128 product = (unsigned __int128)a * b;
  return (uint64_t)product ^ (uint64_t)(product >> 64);
}

static uint64_t mixed(const uint8_t *data, const uint8_t *secret, uint64_t seed) {
  return folded(at(data) ^ (at(secret) + seed), at(data + 8) ^ (at(secret + 8) - seed));
}

static uint64_t finished(uint64_t hash) {
  hash = (hash ^ hash >> 37) * 0x165667919E3779F9;
  return hash ^ hash >> 32;
}

static uint64_t hash_of_8(uint64_t number) {
  uint64_t hash = (number << 32 | number >> 32) ^ (at(SECRET + 8) ^ at(SECRET + 16));
  hash = (hash ^ (hash << 49 | hash >> 15) ^ (hash << 24 | hash >> 40)) * 0x9FB21C651E98DF25;
  hash = (hash ^ ((hash >> 35) + 8)) * 0x9FB21C651E98DF25;
  return hash ^ hash >> 28;
}

/* Of 9 to 64 bytes: of so few, calling xxhash takes several times as long as what it does. */
static uint64_t hash_of(const uint8_t *data, size_t size, uint64_t seed) {
  uint64_t sum = size * 0x9E3779B185EBCA87;
  if (size <= 16) {
    const uint64_t low = at(data) ^ ((at(SECRET + 24) ^ at(SECRET + 32)) + seed);
    const uint64_t high = at(data + size - 8) ^ ((at(SECRET + 40) ^ at(SECRET + 48)) - seed);
    return finished(size + __builtin_bswap64(low) + high + folded(low, high));
  }
  for (size_t i = 0; 32 * i < size; ++i)
    sum += mixed(data + 16 * i, SECRET + 32 * i, seed) +
           mixed(data + size - 16 * (i + 1), SECRET + 32 * i + 16, seed);
  return finished(sum);
}

/* -- RecordBuffer ------------------------------------------------------------------------------- */

typedef struct {
  uint8_t *data;
  size_t size, capacity;
} Bytes;

static int append(Bytes *bytes, const void *data, size_t size) {
  if (bytes->size + size > bytes->capacity) {
    const size_t capacity = 2 * bytes->capacity + LARGE;
    uint8_t *larger = PyMem_Realloc(bytes->data, capacity);
    if (larger == NULL) {
      PyErr_NoMemory();
      return -1;
    }
    bytes->data = larger;
    bytes->capacity = capacity;
  }
  memcpy(bytes->data + bytes->size, data, size);
  bytes->size += size;
  return 0;
}

typedef struct {
  PyObject_HEAD
  PyObject *write_segment, *write_payloads, *sequences, *pieces;
  Py_ssize_t events_max, outputs_max, payload_bytes_max, payload_bytes;
  Bytes events, contents, numbers, headers, records;
} Buffer;

static PyTypeObject *buffer_type;
static PyObject *draw_kind, *no_sequence;

/* "y#" would do, but not for an older version than that of the headers. */
static PyObject *bytes_of(const uint8_t *data, Py_ssize_t size) {
  return PyBytes_FromStringAndSize((const char *)data, size);
}

int check_count(const char *name, Py_ssize_t count, Py_ssize_t least, Py_ssize_t most) {
  if (count >= least && count <= most) return 0;
  PyErr_Format(PyExc_TypeError, "%s() got %zd arguments", name, count);
  return -1;
}

static PyObject *buffer_new(PyTypeObject *type, PyObject *args, PyObject *named) {
  static char *names[] = {"write_segment", "write_payloads", "sequences",
                          "events_max",    "outputs_max",    "payload_bytes_max", NULL};
  PyObject *write_segment, *write_payloads, *sequences;
  Py_ssize_t limits[3];
  Buffer *self;
  if (!PyArg_ParseTupleAndKeywords(args, named, "OOO!nnn", names, &write_segment, &write_payloads,
                                   &PyList_Type, &sequences, limits, limits + 1, limits + 2))
    return NULL;
  self = (Buffer *)PyType_GenericAlloc(type, 0);
  if (self == NULL) return NULL;
  self->write_segment = Py_NewRef(write_segment);
  self->write_payloads = Py_NewRef(write_payloads);
  self->sequences = Py_NewRef(sequences);
  self->events_max = limits[0];
  self->outputs_max = limits[1];
  self->payload_bytes_max = limits[2];
  self->pieces = PyList_New(0);
  if (self->pieces == NULL) Py_CLEAR(self);
  return (PyObject *)self;
}

static int buffer_traverse(Buffer *self, visitproc visit, void *arg) {
  Py_VISIT(Py_TYPE(self));
  Py_VISIT(self->write_segment);
  Py_VISIT(self->write_payloads);
  Py_VISIT(self->sequences);
  return 0;
}

/* Cycles go through the functions only; the lists stay until the end. */
static int buffer_clear(Buffer *self) {
  Py_CLEAR(self->write_segment);
  Py_CLEAR(self->write_payloads);
  return 0;
}

static void buffer_dealloc(Buffer *self) {
  PyTypeObject *type = Py_TYPE(self);
  Bytes *all[] = {&self->events, &self->contents, &self->numbers, &self->headers, &self->records};
  PyObject_GC_UnTrack(self);
  buffer_clear(self);
  Py_CLEAR(self->sequences);
  Py_CLEAR(self->pieces);
  for (int i = 0; i < 5; ++i) PyMem_Free(all[i]->data);
  PyObject_GC_Del(self);
  Py_DECREF(type);
}

/* Returns bytes of the wanted size, or NULL with an error. */
static const uint8_t *packed_bytes(PyObject *packed, Py_ssize_t wanted) {
  char *data;
  Py_ssize_t size;
  if (PyBytes_AsStringAndSize(packed, &data, &size) < 0) return NULL;
  if (size == wanted) return (const uint8_t *)data;
  PyErr_Format(PyExc_ValueError, "%zd bytes where %zd are expected", size, wanted);
  return NULL;
}

/* Stores a number at the place of a row; returns whether it fits. Written out, its size is known. */
static inline __attribute__((always_inline)) int put(uint8_t *row, PyObject *value, size_t size) {
  uint64_t number;
  if (read_number(value, &number) < 0) {
    PyErr_Clear();
    return 0;
  }
  memcpy(row, &number, size);
  return number <= U64 >> (64 - 8 * size);
}

PyObject *attribute_of(const char *module_name, const char *name) {
  PyObject *module = PyImport_ImportModule(module_name), *found;
  if (module == NULL) return NULL;
  found = PyObject_GetAttrString(module, name);
  Py_DECREF(module);
  return found;
}

/* Packs a row as Python does: what does not fit is an error, what is an index may fit. */
static int pack_by(const char *module, const char *name, uint8_t *row, Py_ssize_t size,
                   PyObject *values) {
  PyObject *layout = values == NULL ? NULL : attribute_of(module, name);
  PyObject *pack = layout == NULL ? NULL : PyObject_GetAttrString(layout, "pack");
  PyObject *packed = pack == NULL ? NULL : PyObject_CallObject(pack, values);
  const uint8_t *data = packed == NULL ? NULL : packed_bytes(packed, size);
  if (data != NULL) memcpy(row, data, size);
  Py_XDECREF(values);
  Py_XDECREF(layout);
  Py_XDECREF(pack);
  Py_XDECREF(packed);
  return data == NULL ? -1 : 0;
}

/* Makes a piece of the records so far. */
static int end_piece(Buffer *self) {
  PyObject *piece = bytes_of(self->records.data, self->records.size);
  const int result = piece == NULL ? -1 : PyList_Append(self->pieces, piece);
  Py_XDECREF(piece);
  if (result == 0) self->records.size = 0;
  return result;
}

/* Adds a message, or nothing of it if there is no memory. */
static int add_record(Buffer *self, const uint8_t *header, PyObject *data, const char *content,
                      Py_ssize_t size) {
  const size_t before = self->records.size;
  if (append(&self->headers, header, HEADER) < 0) return -1;
  if (append(&self->records, header, HEADER) == 0 &&
      (size < LARGE ? append(&self->records, content, size) : end_piece(self)) == 0)
    return size < LARGE ? 0 : PyList_Append(self->pieces, data);
  self->headers.size -= HEADER;
  self->records.size = before;
  return -1;
}

/* Returns the sequence of the message in its channel. */
static PyObject *add_payload(Buffer *self, PyObject *channel, PyObject *stamp, PyObject *data) {
  uint8_t header[HEADER] = {MESSAGE};
  PyObject *sequence, *next;
  uint64_t number;
  char *content;
  Py_ssize_t size, length;
  const Py_ssize_t place = PyNumber_AsSsize_t(channel, PyExc_IndexError);
  if (place == -1 && PyErr_Occurred()) return NULL;
  sequence = PyList_GetItem(self->sequences, place);
  if (sequence == NULL || PyBytes_AsStringAndSize(data, &content, &size) < 0 ||
      read_number(sequence, &number) < 0)
    return NULL;
  length = size + HEADER - RECORD_HEAD;
  memcpy(header + 1, &length, 8);
  memcpy(header + 11, &number, 4);
  if (number <= U32 && put(header + 9, channel, 2) && put(header + 15, stamp, 8))
    memcpy(header + 23, header + 15, 8);
  else if (pack_by("rsltrace.trace.mcap.records", "MESSAGE_HEAD", header, HEADER,
                   Py_BuildValue("inOKOO", MESSAGE, length, channel, number, stamp, stamp)) < 0)
    return NULL;
  if (add_record(self, header, data, content, size) < 0) return NULL;
  self->payload_bytes += size + HEADER;
  next = PyLong_FromUnsignedLongLong(number + 1);
  if (next == NULL || PyList_SetItem(self->sequences, place, next) < 0) return NULL;
  if ((self->payload_bytes >= self->payload_bytes_max || number + 1 >= U32) &&
      done(PyObject_CallFunctionObjArgs(self->write_payloads, NULL)) < 0)
    return NULL;
  return PyLong_FromUnsignedLongLong(number);
}

/* ``row`` is packed behind its chain hash. */
static int add_event(Buffer *self, const uint8_t *row) {
  if (append(&self->events, row, EVENT) < 0) return -1;
  if (self->events.size >= (size_t)self->events_max * EVENT ||
      self->contents.size >= (size_t)self->outputs_max * CONTENT)
    return done(PyObject_CallFunctionObjArgs(self->write_segment, NULL));
  return 0;
}

static PyObject *buffer_add_payload(Buffer *self, PyObject *const *args, Py_ssize_t count) {
  if (check_count("add_payload", count, 3, 3) < 0) return NULL;
  return add_payload(self, args[0], args[1], args[2]);
}

static PyObject *buffer_add_event(Buffer *self, PyObject *const *args, Py_ssize_t count) {
  uint8_t row[EVENT];
  const uint8_t *rest;
  uint64_t chain_hash;
  if (check_count("add_event", count, 2, 2) < 0) return NULL;
  rest = packed_bytes(args[0], REST);
  if (rest == NULL || read_number(args[1], &chain_hash) < 0) return NULL;
  memcpy(row, &chain_hash, 8);
  memcpy(row + 8, rest, REST);
  if (add_event(self, row) < 0) return NULL;
  Py_RETURN_NONE;
}

static PyObject *buffer_add_output(Buffer *self, PyObject *packed) {
  const uint8_t *content = packed_bytes(packed, CONTENT);
  if (content == NULL || append(&self->contents, content, CONTENT) < 0) return NULL;
  Py_RETURN_NONE;
}

static int add_sequence(Buffer *self, PyObject *sequence) {
  uint64_t value;
  if (read_number(sequence, &value) < 0) return -1;
  if (value > U32) {
    PyErr_SetString(PyExc_OverflowError, "unsigned int is greater than maximum");
    return -1;
  }
  return append(&self->numbers, &value, 4);
}

static PyObject *buffer_add_sequence(Buffer *self, PyObject *sequence) {
  if (add_sequence(self, sequence) < 0) return NULL;
  Py_RETURN_NONE;
}

static PyObject *buffer_take_payloads(Buffer *self, PyObject *Py_UNUSED(none)) {
  PyObject *none_yet = PyList_New(0), *pieces = self->pieces, *headers = NULL, *taken;
  /* What may collect garbage, which may publish, comes before or after all of this. */
  if (none_yet != NULL && (self->records.size == 0 || end_piece(self) == 0))
    headers = bytes_of(self->headers.data, self->headers.size);
  if (headers == NULL) {
    Py_XDECREF(none_yet);
    return NULL;
  }
  self->pieces = none_yet;
  self->headers.size = self->payload_bytes = 0;
  taken = Py_BuildValue("NN", headers, PyList_AsTuple(pieces));
  Py_DECREF(pieces);
  return taken;
}

static PyObject *buffer_rows(Buffer *self, PyObject *Py_UNUSED(none)) {
  return Py_BuildValue("NNN", bytes_of(self->events.data, self->events.size),
                       bytes_of(self->contents.data, self->contents.size),
                       bytes_of(self->numbers.data, self->numbers.size));
}

static PyObject *buffer_drop_unfinished(Buffer *self, PyObject *Py_UNUSED(none)) {
  size_t outputs = 0, numbered = 0;
  uint32_t value;
  for (size_t place = 8 + REST_OUTPUTS; place < self->events.size; place += EVENT) {
    memcpy(&value, self->events.data + place, 4);
    outputs += value;
  }
  if (outputs * CONTENT < self->contents.size) self->contents.size = outputs * CONTENT;
  for (size_t place = CONTENT_KIND; place < self->contents.size; place += CONTENT) {
    memcpy(&value, self->contents.data + place, 4);
    numbered += value != DRAW;
  }
  if (numbered * 4 < self->numbers.size) self->numbers.size = numbered * 4;
  Py_RETURN_NONE;
}

static PyObject *buffer_clear_rows(Buffer *self, PyObject *Py_UNUSED(none)) {
  self->events.size = self->contents.size = self->numbers.size = 0;
  Py_RETURN_NONE;
}

static PyObject *buffer_events(Buffer *self, void *Py_UNUSED(none)) {
  return PyLong_FromSize_t(self->events.size / EVENT);
}

static PyObject *buffer_outputs(Buffer *self, void *Py_UNUSED(none)) {
  return PyLong_FromSize_t(self->contents.size / CONTENT);
}

static PyMethodDef buffer_methods[] = {
    {"add_payload", (PyCFunction)(void (*)(void))buffer_add_payload, METH_FASTCALL, NULL},
    {"add_event", (PyCFunction)(void (*)(void))buffer_add_event, METH_FASTCALL, NULL},
    {"add_output", (PyCFunction)buffer_add_output, METH_O, NULL},
    {"add_sequence", (PyCFunction)buffer_add_sequence, METH_O, NULL},
    {"take_payloads", (PyCFunction)buffer_take_payloads, METH_NOARGS, NULL},
    {"rows", (PyCFunction)buffer_rows, METH_NOARGS, NULL},
    {"drop_unfinished", (PyCFunction)buffer_drop_unfinished, METH_NOARGS, NULL},
    {"clear_rows", (PyCFunction)buffer_clear_rows, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef buffer_members[] = {
    {"payload_bytes", T_PYSSIZET, offsetof(Buffer, payload_bytes), READONLY, NULL},
    {NULL, 0, 0, 0, NULL},
};

static PyGetSetDef buffer_properties[] = {
    {"events", (getter)buffer_events, NULL, NULL, NULL},
    {"outputs", (getter)buffer_outputs, NULL, NULL, NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyType_Slot buffer_slots[] = {
    {Py_tp_new, buffer_new},           {Py_tp_dealloc, buffer_dealloc},
    {Py_tp_traverse, buffer_traverse}, {Py_tp_clear, buffer_clear},
    {Py_tp_methods, buffer_methods},   {Py_tp_members, buffer_members},
    {Py_tp_getset, buffer_properties}, {0, NULL},
};

static PyType_Spec buffer_spec = {
    "rsltrace._core.RecordBuffer", sizeof(Buffer), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    buffer_slots,
};

/* -- EventChain --------------------------------------------------------------------------------- */

typedef struct {
  PyObject_HEAD
  /* Of the writer. `buffer` is set if its functions are those of a compiled RecordBuffer. */
  PyObject *add_event, *add_output, *add_sequence, *add_payload;
  Buffer *buffer;
  PyObject *observers;
  unsigned long long index, chain_hash, outputs, output_hash;
} Chain;

OBJECTS(chain, (offsetof(Chain, index) - sizeof(PyObject)) / sizeof(PyObject *))

/* Returns whose method a built-in one is, if it is a compiled buffer's; borrowed. */
static Buffer *buffer_of(PyObject *method) {
  PyObject *owner;
  if (!PyCFunction_Check(method)) return NULL;
  owner = PyCFunction_GetSelf(method);
  return owner != NULL && Py_TYPE(owner) == buffer_type ? (Buffer *)owner : NULL;
}

static int chain_init(Chain *self, PyObject *args, PyObject *named) {
  static char *names[] = {"writer", NULL};
  PyObject *writer;
  Buffer *buffer;
  if (!PyArg_ParseTupleAndKeywords(args, named, "O", names, &writer)) return -1;
  if (self->observers != NULL) {
    PyErr_SetString(PyExc_TypeError, "a chain begins once: it may be adding something");
    return -1;
  }
  self->observers = PyTuple_New(0);
  self->add_event = PyObject_GetAttrString(writer, "add_event");
  self->add_output = PyObject_GetAttrString(writer, "add_output");
  self->add_sequence = PyObject_GetAttrString(writer, "add_sequence");
  self->add_payload = PyObject_GetAttrString(writer, "add_payload");
  if (self->observers == NULL || self->add_event == NULL || self->add_output == NULL ||
      self->add_sequence == NULL || self->add_payload == NULL)
    return -1;
  buffer = buffer_of(self->add_event);
  if (buffer != NULL && buffer == buffer_of(self->add_output) &&
      buffer == buffer_of(self->add_sequence) && buffer == buffer_of(self->add_payload))
    self->buffer = (Buffer *)Py_NewRef((PyObject *)buffer);
  return 0;
}

static int add_row(Chain *self, const uint8_t *row) {
  self->output_hash = hash_of(row, CONTENT, self->output_hash);
  if (self->buffer != NULL) {
    if (append(&self->buffer->contents, row, CONTENT) < 0) return -1;
  } else if (done(PyObject_CallFunction(self->add_output, "N", bytes_of(row, CONTENT))) < 0) {
    return -1;
  }
  const Py_ssize_t count = PyTuple_Size(self->observers);
  if (count) {
    PyObject *observers = Py_NewRef(self->observers);
    uint32_t shown[2];
    int failed = 0;
    memcpy(shown, row + 8, 8);
    for (Py_ssize_t i = 0; i < count && !failed; ++i)
      failed = done(PyObject_CallFunction(PyTuple_GetItem(observers, i), "IIK", shown[1], shown[0],
                                          (unsigned long long)at(row)));
    Py_DECREF(observers);
    return failed;
  }
  return 0;
}

static int add_content(Chain *self, PyObject *content_hash, PyObject *entity, PyObject *kind) {
  uint8_t row[CONTENT];
  if (!(put(row, content_hash, 8) && put(row + 8, entity, 4) && put(row + CONTENT_KIND, kind, 4)) &&
      pack_by("rsltrace.trace.format", "OUTPUT_CONTENT", row, CONTENT,
              Py_BuildValue("OOO", content_hash, entity, kind)) < 0)
    return -1;
  return add_row(self, row);
}

/* Adds an output and the sequence of its payload; returns its number in the event. */
static PyObject *add_output(Chain *self, PyObject *kind, PyObject *entity, PyObject *content_hash,
                            PyObject *sequence) {
  if (add_content(self, content_hash, entity, kind) < 0) return NULL;
  if (self->buffer != NULL) {
    if (add_sequence(self->buffer, sequence) < 0) return NULL;
  } else if (done(PyObject_CallFunctionObjArgs(self->add_sequence, sequence, NULL)) < 0) {
    return NULL;
  }
  return PyLong_FromUnsignedLongLong(self->outputs++);
}

static PyObject *chain_output(Chain *self, PyObject *const *args, Py_ssize_t count) {
  if (check_count("output", count, 3, 4) < 0) return NULL;
  return add_output(self, args[0], args[1], args[2], count > 3 ? args[3] : no_sequence);
}

static PyObject *chain_draw(Chain *self, PyObject *const *args, Py_ssize_t count) {
  if (check_count("draw", count, 2, 2) < 0) return NULL;
  if (add_content(self, args[1], args[0], draw_kind) < 0) return NULL;
  self->outputs++;
  Py_RETURN_NONE;
}

static PyObject *chain_message(Chain *self, PyObject *const *args, Py_ssize_t count) {
  PyObject *sequence, *position;
  long channel;
  if (check_count("message", count, 6, 6) < 0) return NULL;
  channel = PyLong_AsLong(args[2]);
  if (channel == -1 && PyErr_Occurred()) return NULL;
  if (channel < 0)
    sequence = Py_NewRef(no_sequence);
  else if (self->buffer != NULL)
    sequence = add_payload(self->buffer, args[2], args[3], args[4]);
  else
    sequence = PyObject_CallFunctionObjArgs(self->add_payload, args[2], args[3], args[4], NULL);
  if (sequence == NULL) return NULL;
  position = add_output(self, args[0], args[1], args[5], sequence);
  Py_DECREF(sequence);
  return position;
}

static int pack_rest(Chain *self, PyObject *const *args, Py_ssize_t count, uint8_t *row) {
  const uint32_t outputs = (uint32_t)self->outputs;
  memcpy(row, &self->index, 8);
  memcpy(row + 32, &self->output_hash, 8);
  memcpy(row + REST_OUTPUTS, &outputs, 4);
  if (outputs == self->outputs && put(row + 8, args[0], 8) && put(row + 60, args[1], 1) &&
      put(row + 61, args[2], 1) && put(row + 48, args[3], 4) && put(row + 16, args[4], 8) &&
      put(row + 52, args[5], 4) && put(row + 24, args[6], 8) &&
      (count < 8 || put(row + 40, args[7], 8)))
    return 0;
  return pack_by("rsltrace.trace.format", "EVENT_REST", row, REST,
                 Py_BuildValue("KOOOKNOOKOO", self->index, args[0], args[4], args[6],
                               self->output_hash,
                               count < 8 ? PyLong_FromLong(0) : Py_NewRef(args[7]), args[3],
                               args[5], self->outputs, args[1], args[2]));
}

static PyObject *chain_end_event(Chain *self, PyObject *const *args, Py_ssize_t count) {
  uint8_t row[EVENT] = {0}, *rest = row + 8;
  if (check_count("end_event", count, 7, 8) < 0 || pack_rest(self, args, count, rest) < 0)
    return NULL;
  self->chain_hash = hash_of(rest, REST, self->chain_hash);
  memcpy(row, &self->chain_hash, 8);
  if (self->buffer != NULL) {
    if (add_event(self->buffer, row) < 0) return NULL;
  } else if (done(PyObject_CallFunction(self->add_event, "NK", bytes_of(rest, REST),
                                        self->chain_hash)) < 0) {
    return NULL;
  }
  self->index++;
  self->outputs = self->output_hash = 0;
  Py_RETURN_NONE;
}

static PyObject *chain_tell(Chain *self, PyObject *observers) {
  PyObject *all = PySequence_Tuple(observers), *old = self->observers;
  if (all == NULL) return NULL;
  self->observers = all;
  Py_XDECREF(old);
  Py_RETURN_NONE;
}

static PyMethodDef chain_methods[] = {
    {"output", (PyCFunction)(void (*)(void))chain_output, METH_FASTCALL, NULL},
    {"draw", (PyCFunction)(void (*)(void))chain_draw, METH_FASTCALL, NULL},
    {"message", (PyCFunction)(void (*)(void))chain_message, METH_FASTCALL, NULL},
    {"end_event", (PyCFunction)(void (*)(void))chain_end_event, METH_FASTCALL, NULL},
    {"tell", (PyCFunction)chain_tell, METH_O, NULL},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef chain_members[] = {
    {"index", T_ULONGLONG, offsetof(Chain, index), 0, NULL},
    {"chain_hash", T_ULONGLONG, offsetof(Chain, chain_hash), 0, NULL},
    {"outputs", T_ULONGLONG, offsetof(Chain, outputs), 0, NULL},
    {"output_hash", T_ULONGLONG, offsetof(Chain, output_hash), 0, NULL},
    {NULL, 0, 0, 0, NULL},
};

static PyType_Slot chain_slots[] = {
    {Py_tp_init, chain_init},         {Py_tp_new, PyType_GenericNew},
    {Py_tp_dealloc, chain_dealloc},   {Py_tp_traverse, chain_traverse},
    {Py_tp_clear, chain_clear},       {Py_tp_methods, chain_methods},
    {Py_tp_members, chain_members},   {0, NULL},
};

static PyType_Spec chain_spec = {
    "rsltrace._core.EventChain", sizeof(Chain), 0,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC, chain_slots,
};

/* -- fields ------------------------------------------------------------------------------------- */

PyTypeObject *event_type, *dispatcher_type, *entity_type, *timers_type;
/* Subclasses: see is_a. */
PyObject *loop_seen, *event_seen, *dispatcher_seen, *subscription_seen, *timers_seen;
PyObject *deque_type;
static PyTypeObject *sites_type, *chain_type, *timer_type, *subscription_type;
static PyObject *sites_seen, *timer_seen, *publisher_seen, *node_seen, *chain_seen;
static PyObject *hash64, *zero;
PyCFunction deque_popleft;
static PyCFunction deque_append;
static PyObject *dispatch_name, *dispatch_usual, *heapreplace, *no_event, *no_args;
static PyObject *callback_group, *active_entity, *user_callback, *timer_callback, *raw, *admitted;

typedef struct {
  PyObject_HEAD
  PyObject *period_ns, *order, *deadline_ns, *ticket, *last_call_ns;
} TimerState;

FIELDS(Event, event, "EventFields")
FIELDS(Dispatcher, dispatcher, "EventEnd")
FIELDS(Entity, entity, "EntityFields")
FIELDS(Sites, sites, "SitesFields")
FIELDS(TimerState, timer, "TimerStateFields")
FIELDS(TimerQueue, timers, "TimerQueueFields")

PyMemberDef event_fields[] = {
    FIELD(Event, handle, "handle"), FIELD(Event, entity, "entity"),
    FIELD(Event, node, "node"), FIELD(Event, kind, "kind"),
    FIELD(Event, cause_event, "cause_event"), FIELD(Event, cause_output, "cause_output"),
    FIELD(Event, input_hash, "input_hash"), FIELD(Event, flags, "flags"),
    FIELD(Event, quiet, "quiet"), FIELD(Event, busy_ns, "busy_ns"),
    FIELD(Event, on_end, "on_end"), NO_FIELD,
};

static PyMemberDef sites_fields[] = {
    FIELD(Sites, due, "due"), FIELD(Sites, running, "running"), NO_FIELD,
};

static PyMemberDef timer_fields[] = {
    FIELD(TimerState, period_ns, "period_ns"),     FIELD(TimerState, order, "order"),
    FIELD(TimerState, deadline_ns, "deadline_ns"), FIELD(TimerState, ticket, "ticket"),
    FIELD(TimerState, last_call_ns, "last_call_ns"), NO_FIELD,
};

static PyMemberDef timers_fields[] = {
    FIELD(TimerQueue, heap, "_heap"), FIELD(TimerQueue, head, "head"),
    FIELD(TimerQueue, next_ns, "next_ns"), NO_FIELD,
};

PyMemberDef dispatcher_fields[] = {
    FIELD(Dispatcher, loop, "loop"),
    FIELD(Dispatcher, event, "event"),
    FIELD(Dispatcher, entities, "entities"),
    FIELD(Dispatcher, recorder, "recorder"),
    FIELD(Dispatcher, unrecorded, "unrecorded"),
    FIELD(Dispatcher, pending, "_pending"),
    FIELD(Dispatcher, before, "_before"),
    FIELD(Dispatcher, after, "_after"),
    FIELD(Dispatcher, call_back, "_call_back"),
    FIELD(Dispatcher, call_back_with, "_call_back_with"),
    NO_FIELD,
};

PyMemberDef entity_fields[] = {
    FIELD(Entity, active, "active"), FIELD(Entity, state, "state"),
    FIELD(Entity, queue, "queue"), FIELD(Entity, keep, "keep"),
    FIELD(Entity, node, "node"), FIELD(Entity, destroyed, "destroyed"),
    FIELD(Entity, wrapper, "wrapper"), FIELD(Entity, own_group, "own_group"),
    FIELD(Entity, mailbox, "mailbox"), FIELD(Entity, callback, "_callback"),
    FIELD(Entity, coroutine, "_coroutine"), FIELD(Entity, with_info, "_with_info"),
    FIELD(Entity, deserialize, "_deserialize"), FIELD(Entity, serialize, "_serialize"),
    FIELD(Entity, sites, "_sites"), FIELD(Entity, dispatcher, "dispatcher"),
    FIELD(Entity, entity_id, "entity_id"), FIELD(Entity, subscriptions, "subscriptions"),
    FIELD(Entity, links, "links"), FIELD(Entity, observers, "observers"),
    FIELD(Entity, count, "_count"), FIELD(Entity, channel, "_channel"),
    FIELD(Entity, output_kind, "_output_kind"), FIELD(Entity, history, "_history"),
    FIELD(Entity, offers, "_offers"), FIELD(Entity, faults, "_faults"),
    NO_FIELD,
};

void refuse(PyObject *object, PyTypeObject *type, const PyMemberDef *fields, size_t first) {
  if (object == NULL || !PyObject_TypeCheck(object, type)) {
    PyErr_SetString(PyExc_TypeError, "a part of the run is missing, or of another class");
    return;
  }
  while (((PyObject **)(object + 1))[first] != NULL) ++first;
  PyErr_SetString(PyExc_AttributeError, fields[first].name);
}

static int is_publisher(PyObject *object) {
  const size_t first = FIELD_PLACE(Entity, dispatcher);
  return has_fields(object, entity_type, &publisher_seen, entity_fields, first,
                    FIELD_COUNT(Entity));
}

int set(PyObject **field, PyObject *value) {
  PyObject *old = *field;
  if (value == NULL) return -1;
  *field = value;
  Py_XDECREF(old);
  return 0;
}

/* Returns the function of a built-in method with such arguments, else NULL. */
static PyCFunction function_of(PyObject *method, int flags) {
  if (method == NULL || !PyCFunction_Check(method) || PyCFunction_GetFlags(method) != flags)
    return NULL;
  return PyCFunction_GetFunction(method);
}

/* Calls directly what is built in, as a plan's methods are. */
PyObject *call_one(PyObject *callable, PyObject *argument) {
  const PyCFunction function = function_of(callable, METH_O);
  if (function != NULL) return function(PyCFunction_GetSelf(callable), argument);
  return PyObject_CallFunctionObjArgs(callable, argument, NULL);
}

PyObject *call_two(PyObject *callable, PyObject *first, PyObject *second) {
  PyObject *both[] = {first, second};
  const PyCFunction function = function_of(callable, METH_FASTCALL);
  if (function == NULL) return PyObject_CallFunctionObjArgs(callable, first, second, NULL);
  return ((_PyCFunctionFast)(void (*)(void))function)(PyCFunction_GetSelf(callable), both, 2);
}

static int add_one(PyObject **field) {
  uint64_t value;
  return read_number(*field, &value) < 0 ? -1 : set(field, PyLong_FromUnsignedLongLong(value + 1));
}

int done(PyObject *result) {
  Py_XDECREF(result);
  return result == NULL ? -1 : 0;
}

static int call_method(PyObject *object, const char *name) {
  return done(PyObject_CallMethod(object, name, NULL));
}

/* -- Dispatcher --------------------------------------------------------------------------------- */

static PyObject *state_hash_of(PyObject *node) {
  PyObject *state, *hash;
  if (node == Py_None) return Py_NewRef(zero);
  if (is_a(node, entity_type, &node_seen) && ((Entity *)node)->state != NULL)
    state = Py_NewRef(((Entity *)node)->state);
  else
    state = PyObject_GetAttrString(node, "state");
  if (state == NULL) return NULL;
  hash = state == Py_None ? Py_NewRef(zero) : PyObject_CallMethod(state, "after_event", NULL);
  Py_DECREF(state);
  return hash;
}

static int record_end(Dispatcher *self, PyObject *recorder, Loop *loop, Event *event,
                      PyObject *state_hash) {
  PyObject *row[] = {loop->now_ns,       event->kind,         event->flags,      event->entity,
                     event->cause_event, event->cause_output, event->input_hash, state_hash};
  if (recorder == Py_None) return set(&self->unrecorded, Py_NewRef(zero));
  for (int i = 0; i < 8; ++i) Py_INCREF(row[i]);
  PyObject *result = is_a(recorder, chain_type, &chain_seen)
                         ? chain_end_event((Chain *)recorder, row, 8)
                         : PyObject_CallMethod(recorder, "end_event", "OOOOOOOO", row[0], row[1],
                                               row[2], row[3], row[4], row[5], row[6], row[7]);
  for (int i = 0; i < 8; ++i) Py_DECREF(row[i]);
  return done(result);
}

int record_draw(PyObject *recorder, PyObject *entity, unsigned long long draw) {
  const uint32_t kind = DRAW;
  uint8_t row[CONTENT];
  if (!is_a(recorder, chain_type, &chain_seen) || !put(row + 8, entity, 4))
    return done(PyObject_CallMethod(recorder, "draw", "OK", entity, draw));
  memcpy(row, &draw, 8);
  memcpy(row + CONTENT_KIND, &kind, 4);
  if (add_row((Chain *)recorder, row) < 0) return -1;
  ((Chain *)recorder)->outputs++;
  return 0;
}

static int settle_entities(Dispatcher *self) {
  if (PyList_CheckExact(self->pending) && PyList_Size(self->pending) == 0) return 0;
  if (done(PyObject_CallMethod(self->entities, "settle", "O", self->recorder)) < 0) return -1;
  return HAS_FIELDS(self, Dispatcher, dispatcher) ? 0 : -1;
}

static int tell_observers(Dispatcher *self) {
  if (!HAS_FIELDS(self, Dispatcher, dispatcher)) return -1;
  PyObject *observers = Py_NewRef(self->after);
  const Py_ssize_t count = PyTuple_Size(observers);
  int failed = count < 0;
  for (Py_ssize_t i = 0; i < count && !failed; ++i)
    failed = call_method(PyTuple_GetItem(observers, i), "after_event") < 0;
  Py_DECREF(observers);
  return failed ? -1 : 0;
}

static int end_event(Dispatcher *self) {
  PyObject *node, *recorder, *state_hash = NULL;
  int failed = 1;
  Event *event;
  Loop *loop;
  if (!HAS_FIELDS(self, Dispatcher, dispatcher) || settle_entities(self) < 0) return -1;
  event = (Event *)Py_NewRef(self->event);
  loop = (Loop *)Py_NewRef(self->loop);
  recorder = Py_NewRef(self->recorder);
  if (HAS_FIELD(event, Event, event, node)) {
    node = Py_NewRef(event->node);
    state_hash = state_hash_of(node);
    Py_DECREF(node);
  }
  if (state_hash != NULL && HAS_FIELDS(event, Event, event) && HAS_FIELDS(loop, Loop, loop) &&
      record_end(self, recorder, loop, event, state_hash) == 0 &&
      HAS_FIELD(loop, Loop, loop, events) &&
      add_one(&loop->events) == 0 && set(&event->flags, Py_NewRef(zero)) == 0 &&
      set(&event->quiet, Py_NewRef(Py_False)) == 0 && tell_observers(self) == 0)
    failed = 0;
  Py_XDECREF(state_hash);
  Py_DECREF(recorder);
  Py_DECREF(loop);
  Py_DECREF(event);
  return failed ? -1 : 0;
}

static PyObject *dispatcher_end_event(Dispatcher *self, PyObject *Py_UNUSED(none)) {
  return end_event(self) < 0 ? NULL : Py_NewRef(Py_None);
}

enum { HANDLE, ENTITY, NODE, KIND, CALLBACK, ARGS, CAUSE_EVENT, CAUSE_OUTPUT, INPUT_HASH, CALL };

/* What calls the callback is Python, as who looks at the stack finds its frame there, and what a
   callback raises passes through it. */
static int run_event(Dispatcher *self, PyObject *const *call, int has_one) {
  static const int begins[] = {HANDLE, ENTITY, NODE, KIND, CAUSE_EVENT, CAUSE_OUTPUT, INPUT_HASH};
  int failed;
  if (!HAS_FIELDS(self, Dispatcher, dispatcher) || !HAS_FIELD(self->event, Event, event, handle))
    return -1;
  Event *event = (Event *)Py_NewRef(self->event);
  PyObject *caller = Py_NewRef(has_one ? self->call_back_with : self->call_back);
  for (int i = 0; i < 7; ++i) set(&event->handle + i, Py_NewRef(call[begins[i]]));
  failed = done(PyObject_CallFunctionObjArgs(caller, self, call[HANDLE], call[CALLBACK], call[ARGS],
                                             NULL)) < 0 ||
           end_event(self) < 0 || !HAS_FIELD(event, Event, event, on_end);
  Py_DECREF(caller);
  if (!failed && event->on_end != Py_None) {
    PyObject *on_end = event->on_end;
    event->on_end = Py_NewRef(Py_None);
    failed = done(PyObject_CallObject(on_end, NULL)) < 0;
    Py_DECREF(on_end);
  }
  Py_DECREF(event);
  return failed ? -1 : 0;
}

/* With ``has_one``, ARGS is the only argument, and no tuple. */
static int execute(Dispatcher *self, PyObject *const *call, int has_one, int is_decided) {
  const int is_steered = is_decided || self->before == NULL ? 0 : PyObject_IsTrue(self->before);
  if (is_steered == 0) return run_event(self, call, has_one);
  if (is_steered < 0) return -1;
  return done(PyObject_CallMethod((PyObject *)self, "ask_and_execute",
                                  has_one ? "OOOOO(O)OOO" : "OOOOOOOOO", call[HANDLE], call[ENTITY],
                                  call[NODE], call[KIND], call[CALLBACK], call[ARGS],
                                  call[CAUSE_EVENT], call[CAUSE_OUTPUT], call[INPUT_HASH]));
}

static PyObject *dispatcher_execute(Dispatcher *self, PyObject *const *args, Py_ssize_t count) {
  PyObject *call[CALL];
  if (check_count("execute", count, CALL, CALL + 1) < 0) return NULL;
  memcpy(call, args, sizeof call);
  const int has_one = PyTuple_Check(call[ARGS]) && PyTuple_Size(call[ARGS]) == 1;
  if (has_one) call[ARGS] = PyTuple_GetItem(call[ARGS], 0);
  const int is_decided = count > CALL ? PyObject_IsTrue(args[CALL]) : 0;
  if (is_decided < 0 || execute(self, call, has_one, is_decided) < 0) return NULL;
  Py_RETURN_NONE;
}

static PyMethodDef dispatcher_methods[] = {
    {"execute", (PyCFunction)(void (*)(void))dispatcher_execute, METH_FASTCALL, NULL},
    {"end_event", (PyCFunction)dispatcher_end_event, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

/* -- Publisher ---------------------------------------------------------------------------------- */

/* Whether an object, or NULL, is what the functions of a deque take: they do not look. */
static int is_deque(PyObject *queue) {
  return queue != NULL && (PyObject *)Py_TYPE(queue) == deque_type;
}

int append_to(PyObject *queue, PyObject *item) {
  Py_INCREF(queue);
  const int failed = done(is_deque(queue) ? deque_append(queue, item)
                                          : PyObject_CallMethod(queue, "append", "(O)", item));
  Py_DECREF(queue);
  return failed;
}

/* Whether a queue has as many items as it keeps. */
static int is_full(PyObject *queue, PyObject *keep) {
  Py_ssize_t count, most;
  if (keep == Py_None) return 0;
  count = PyObject_Length(queue);
  most = PyLong_AsSsize_t(keep);
  return count < 0 || (most == -1 && PyErr_Occurred()) ? -1 : count == most;
}

int queue_arrival(PyObject *receiver, PyObject *arrival) {
  Entity *to = (Entity *)receiver;
  int is_it;
  if (!is_a(receiver, entity_type, &subscription_seen) || to->queue == NULL || to->keep == NULL) {
    PyErr_SetString(PyExc_TypeError, "a subscription has no queue");
    return -1;
  }
  PyObject *queue = Py_NewRef(to->queue), *keep = Py_NewRef(to->keep);
  is_it = is_full(queue, keep);
  const int failed = is_it < 0 || (is_it && call_method(receiver, "drop") < 0) ||
                     append_to(queue, arrival) < 0;
  Py_DECREF(keep);
  Py_DECREF(queue);
  if (failed) return -1;
  if (to->active == NULL) {
    PyErr_SetString(PyExc_TypeError, "a subscription has lost its fields");
    return -1;
  }
  PyObject *active = Py_NewRef(to->active);
  is_it = PyObject_IsTrue(active);
  Py_DECREF(active);
  return is_it ? is_it : call_method(receiver, "awaken");
}

static int deliver(PyObject *subscription, PyObject *delivery, Loop *loop) {
  const int is_ready = queue_arrival(subscription, delivery);
  if (is_ready <= 0) return is_ready;
  return HAS_FIELDS(loop, Loop, loop) ? append_to(loop->ready, subscription) : -1;
}

/* Over the links, or to the subscriptions. `message` is a delivery from the CDR on. */
static int send_to_all(Entity *self, PyObject *const *message, PyObject *now_ns, Loop *loop) {
  const int has_links = self->links != Py_None;
  PyObject *all = Py_NewRef(has_links ? self->links : self->subscriptions), *delivery = NULL;
  if (!has_links) /* packing may collect garbage: it may publish */
    delivery = PyTuple_Pack(10, now_ns, zero, zero, Py_None, message[0], message[1], message[2],
                            message[3], message[4], message[5]);
  int failed = (!has_links && delivery == NULL) || PyList_Size(all) < 0;
  for (Py_ssize_t i = 0; i < PyList_Size(all) && !failed; ++i) {
    PyObject *to = Py_NewRef(PyList_GetItem(all, i));
    failed = (has_links ? send_over(to, message) : deliver(to, delivery, loop)) < 0;
    Py_DECREF(to);
  }
  Py_XDECREF(delivery);
  Py_DECREF(all);
  return failed;
}

static PyObject *digest_of(PyObject *data) {
  const Py_ssize_t size = PyBytes_CheckExact(data) ? PyBytes_Size(data) : 0;
  if (size < 9 || size > 64) return PyObject_CallFunctionObjArgs(hash64, data, NULL);
  return PyLong_FromUnsignedLongLong(hash_of((uint8_t *)PyBytes_AsString(data), size, 0));
}

/* Records a message; returns its digest and its position in the event. */
static int record_message(Entity *self, PyObject *recorder, PyObject *now_ns, PyObject *data,
                          PyObject *content_hash, PyObject **digest, PyObject **position) {
  PyObject *row[6];
  *digest = content_hash != Py_None ? Py_NewRef(content_hash) : digest_of(data);
  if (*digest == NULL || !is_publisher((PyObject *)self)) return -1;
  row[0] = Py_NewRef(self->output_kind);
  row[1] = Py_NewRef(self->entity_id);
  row[2] = Py_NewRef(self->channel);
  row[3] = Py_NewRef(now_ns);
  row[4] = data, row[5] = *digest;
  *position = chain_message((Chain *)recorder, row, 6);
  for (int i = 0; i < 4; ++i) Py_DECREF(row[i]);
  return *position == NULL ? -1 : 0;
}

static int send_plainly(Entity *self, Dispatcher *dispatcher, PyObject *data,
                        PyObject *content_hash) {
  PyObject *digest = NULL, *position = NULL, *now_ns = NULL;
  PyObject *recorder = Py_NewRef(dispatcher->recorder);
  Loop *loop = (Loop *)Py_NewRef(dispatcher->loop);
  int failed = !HAS_FIELDS(loop, Loop, loop);
  if (!failed) now_ns = Py_NewRef(loop->now_ns);
  failed = failed || add_one(&self->count) < 0;
  if (!failed && recorder != Py_None) {
    failed = record_message(self, recorder, now_ns, data, content_hash, &digest, &position) < 0;
  } else if (!failed) {
    failed = add_one(&dispatcher->unrecorded);
    digest = Py_NewRef(zero);
    position = Py_NewRef(zero);
  }
  failed = failed || set(&loop->activity_ns, Py_NewRef(now_ns)) < 0 ||
           !HAS_FIELDS(loop, Loop, loop) || !is_publisher((PyObject *)self);
  if (!failed) {
    PyObject *events = Py_NewRef(loop->events), *number = Py_NewRef(self->count);
    PyObject *message[] = {data, events, position, digest, now_ns, number};
    failed = send_to_all(self, message, now_ns, loop);
    Py_DECREF(number);
    Py_DECREF(events);
  }
  Py_XDECREF(now_ns);
  Py_XDECREF(position);
  Py_XDECREF(digest);
  Py_DECREF(loop);
  Py_DECREF(recorder);
  return failed ? -1 : 0;
}

static PyObject *publisher_send(Entity *self, PyObject *const *args, Py_ssize_t count) {
  PyObject *content_hash, *recorder;
  Dispatcher *dispatcher;
  if (check_count("send", count, 1, 2) < 0 || !is_publisher((PyObject *)self)) return NULL;
  dispatcher = (Dispatcher *)self->dispatcher;
  if (!HAS_FIELDS(dispatcher, Dispatcher, dispatcher)) return NULL;
  content_hash = count > 1 ? args[1] : Py_None;
  recorder = dispatcher->recorder;
  if (self->observers != Py_None || self->history != Py_None || self->offers != Py_None ||
      self->faults != Py_None || !PyList_Check(self->subscriptions) ||
      (self->links != Py_None && !PyList_Check(self->links)) ||
      (recorder != Py_None &&
       (self->channel == Py_None || !is_a(recorder, chain_type, &chain_seen))))
    return PyObject_CallMethod((PyObject *)self, "send_any", "OO", args[0], content_hash);
  Py_INCREF(dispatcher);
  const int failed = send_plainly(self, dispatcher, args[0], content_hash);
  Py_DECREF(dispatcher);
  return failed ? NULL : Py_NewRef(Py_None);
}

/* Whether the line that publishes is to be looked up (concurrency/code_lines.py); -1 with an
   error. */
static int is_site_due(Entity *self) {
  Dispatcher *dispatcher = (Dispatcher *)self->dispatcher;
  Sites *sites = (Sites *)self->sites;
  PyObject *entity, *running;
  uint64_t count, due_at;
  if (!HAS_FIELD(dispatcher, Dispatcher, dispatcher, event) ||
      !HAS_FIELD(dispatcher->event, Event, event, entity) || !HAS_FIELDS(sites, Sites, sites) ||
      read_number(self->count, &count) < 0 || read_number(sites->due, &due_at) < 0)
    return -1;
  if (count == due_at) return 1;
  entity = Py_NewRef(((Event *)dispatcher->event)->entity), running = Py_NewRef(sites->running);
  const int due = PyObject_RichCompareBool(entity, running, Py_NE);
  Py_DECREF(running);
  Py_DECREF(entity);
  return due;
}

static PyObject *publisher_publish(Entity *self, PyObject *message) {
  PyObject *serialize, *data, *result;
  const int due = is_publisher((PyObject *)self) ? is_site_due(self) : -1;
  if (due < 0) return NULL;
  if (due || self->serialize == NULL)
    return PyObject_CallMethod((PyObject *)self, "publish_any", "(O)", message);
  serialize = Py_NewRef(self->serialize);
  data = call_one(serialize, message);
  Py_DECREF(serialize);
  result = data == NULL ? NULL : publisher_send(self, &data, 1);
  Py_XDECREF(data);
  return result;
}

static PyMethodDef publisher_methods[] = {
    {"publish", (PyCFunction)publisher_publish, METH_O, NULL},
    {"send", (PyCFunction)(void (*)(void))publisher_send, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};

static PyMethodDef no_methods[] = {{NULL, NULL, 0, NULL}};

/* -- Subscription ------------------------------------------------------------------------------- */

/* Whether an attribute is an object; -1 with an error. */
static int has(PyObject *object, PyObject *name, PyObject *wanted) {
  PyObject *found = PyObject_GetAttr(object, name);
  Py_XDECREF(found);
  return found == NULL ? -1 : found == wanted;
}

static int is_free(PyObject *wrapper) {
  PyObject *group = PyObject_GetAttr(wrapper, callback_group);
  const int free = group == NULL ? -1 : has(group, active_entity, Py_None);
  Py_XDECREF(group);
  return free;
}

/* Whether an entity has a plain function, without further arguments, that may run now; -1 with an
   error. */
static int is_usual(Entity *self, PyObject *name_of_callback) {
  PyObject *wrapper = self->wrapper, *callback = self->callback;
  int usual;
  if (self->destroyed != Py_False || self->own_group != Py_False || self->coroutine != Py_False ||
      self->with_info != Py_False || wrapper == NULL || callback == NULL)
    return 0;
  Py_INCREF(wrapper);
  Py_INCREF(callback);
  usual = is_free(wrapper);
  if (usual > 0) usual = has(wrapper, name_of_callback, callback);
  if (usual > 0 && self->queue != NULL) usual = has(wrapper, raw, Py_False);
  Py_DECREF(callback);
  Py_DECREF(wrapper);
  if (usual < 0 && PyErr_ExceptionMatches(PyExc_AttributeError)) {
    PyErr_Clear();
    usual = 0;
  }
  return usual > 0 ? self->callback != NULL && self->node != NULL && self->entity_id != NULL &&
                         self->dispatcher != NULL
                   : usual;
}

/* Returns the mailbox of an entity's node, borrowed, or NULL if it is not known. */
static PyObject *mailbox_of(Entity *self) {
  PyObject *node = self->node;
  return node != NULL && is_a(node, entity_type, &node_seen) ? ((Entity *)node)->mailbox : NULL;
}

/* Whether nobody but the loop runs the node, or the executor that does has taken this entity out of
   its mailbox (Mailbox.keeps); -1 with an error. */
static int is_admitted(Entity *self) {
  PyObject *mailbox = mailbox_of(self);
  int is_it;
  if (mailbox == NULL || mailbox == Py_None) return mailbox != NULL;
  Py_INCREF(mailbox);
  is_it = has(mailbox, admitted, (PyObject *)self);
  if (is_it > 0 && PyObject_SetAttr(mailbox, admitted, Py_None) < 0) is_it = -1;
  Py_DECREF(mailbox);
  return is_it;
}

/* Runs a callback (see execute); ``cause`` has the event, its output and the hash of the input. */
static int run_callback(Entity *self, long number, PyObject *callback, PyObject *args, int has_one,
                        PyObject *const *cause) {
  PyObject *kind = PyLong_FromLong(number);
  PyObject *entity = Py_XNewRef(self->entity_id), *node = Py_XNewRef(self->node);
  Dispatcher *dispatcher = (Dispatcher *)Py_XNewRef(self->dispatcher);
  int failed = 1;
  if (entity == NULL || node == NULL) {
    PyErr_SetString(PyExc_AttributeError, "an entity has lost its id or node");
  } else if (kind != NULL && HAS_FIELDS(dispatcher, Dispatcher, dispatcher)) {
    PyObject *call[CALL] = {(PyObject *)self, entity,   node,     kind,    callback,
                            args,             cause[0], cause[1], cause[2]};
    failed = execute(dispatcher, call, has_one, 0);
  }
  Py_XDECREF(dispatcher);
  Py_XDECREF(node);
  Py_XDECREF(entity);
  Py_XDECREF(kind);
  return failed;
}

/* Runs the callback for a delivery of the middleware (subscription.Delivery). */
static int run_subscription(Entity *self, PyObject *delivery) {
  PyObject *callback = Py_NewRef(self->callback), *deserialize = Py_NewRef(self->deserialize);
  PyObject *message = call_one(deserialize, PyTuple_GetItem(delivery, 4)), *cause[3];
  for (int i = 0; i < 3; ++i) cause[i] = PyTuple_GetItem(delivery, 5 + i);
  const int failed =
      message == NULL || run_callback(self, SUBSCRIPTION, callback, message, 1, cause);
  Py_XDECREF(message);
  Py_DECREF(deserialize);
  Py_DECREF(callback);
  return failed;
}

static PyObject *subscription_dispatch(Entity *self, PyObject *Py_UNUSED(none)) {
  PyObject *delivery;
  int failed = 1, usual = 0;
  if (is_deque(self->queue) && PyObject_Length(self->queue) > 0)
    usual = is_usual(self, user_callback);
  if (usual > 0) usual = is_admitted(self);
  if (usual < 0) return NULL;
  if (!usual || !is_deque(self->queue) || self->callback == NULL || self->deserialize == NULL)
    return PyObject_CallMethod((PyObject *)self, "dispatch_any", NULL);
  delivery = deque_popleft(self->queue, NULL);
  if (delivery == NULL) return NULL;
  if (PyTuple_Check(delivery) && PyTuple_Size(delivery) == 10)
    failed = run_subscription(self, delivery);
  else
    PyErr_SetString(PyExc_ValueError, "a delivery has ten parts");
  Py_DECREF(delivery);
  return failed ? NULL : Py_NewRef(Py_None);
}

static PyMethodDef subscription_methods[] = {
    {"dispatch", (PyCFunction)subscription_dispatch, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

/* Runs what is ready. ``seen`` is the last class whose method is the one above: to call that from
   here is faster than as a method. */
int dispatch(PyObject *item) {
  static PyObject *seen;
  PyObject *type = (PyObject *)Py_TYPE(item), *method;
  if (type != seen && PyType_IsSubtype((PyTypeObject *)type, subscription_type)) {
    method = PyObject_GetAttr(type, dispatch_name);
    if (method == dispatch_usual) set(&seen, Py_NewRef(type));
    if (done(method) < 0) return -1;
  }
  return done(type == seen ? subscription_dispatch((Entity *)item, NULL)
                           : PyObject_CallMethodObjArgs(item, dispatch_name, NULL));
}

/* -- Timer -------------------------------------------------------------------------------------- */

/* Whether a number is a time that others can be added to. */
static int is_ns(PyObject *value, int64_t *ns) {
  int overflow = 1;
  *ns = PyLong_Check(value) ? PyLong_AsLongLongAndOverflow(value, &overflow) : 0;
  return !overflow && *ns >= 0 && *ns < INT64_MAX / 4;
}

/* Whether a timer is the first of those that wait in order (CreationOrderQueue). */
static int is_first(TimerQueue *queue, TimerState *state) {
  return queue != NULL && is_a((PyObject *)queue, timers_type, &timers_seen) &&
         queue->heap != NULL && PyList_Check(queue->heap) && PyList_Size(queue->heap) > 0 &&
         PyList_GetItem(queue->heap, 0) == state->ticket;
}

/* Returns the time after a call (TimerState.call). */
static PyObject *next_deadline(int64_t now, int64_t deadline, int64_t period) {
  if (period <= 0) period = 1000000; /* ZERO_PERIOD_NS */
  deadline += period;
  if (deadline <= now)
    deadline += (1 + (now - deadline) / period) * period;
  return PyLong_FromLongLong(deadline);
}

/* Notes which timer is first now. */
static int find_first(TimerQueue *queue, PyObject *heap) {
  PyObject *first = PyList_Size(heap) > 0 ? PyList_GetItem(heap, 0) : Py_None, *timer;
  int failed;
  timer = PyTuple_Check(first) && PyTuple_Size(first) == 3 ? PyTuple_GetItem(first, 2) : Py_None;
  if (!is_a(timer, timer_type, &timer_seen) || ((TimerState *)timer)->ticket != first)
    return call_method((PyObject *)queue, "_find_head");
  Py_INCREF(first);
  failed = set(&queue->next_ns, Py_NewRef(PyTuple_GetItem(first, 0))) < 0 ||
           set(&queue->head, Py_NewRef(timer)) < 0;
  Py_DECREF(first);
  return failed ? -1 : 0;
}

static PyObject *timer_dispatch(Entity *self, PyObject *Py_UNUSED(none)) {
  PyObject *entry = PyTuple_New(3); /* first, as it may collect garbage: see send_plainly */
  Dispatcher *dispatcher;
  Loop *loop;
  TimerQueue *queue;
  TimerState *state;
  int64_t now = 0, deadline = 0, period = 0;
  int failed, usual = entry == NULL ? -1 : is_usual(self, timer_callback);
  if (usual > 0) {
    /* Nothing from here on to the replacements runs code of Python. */
    dispatcher = (Dispatcher *)self->dispatcher;
    state = (TimerState *)self->state;
    usual = HAS_FIELDS(dispatcher, Dispatcher, dispatcher) &&
                    HAS_FIELDS(loop = (Loop *)dispatcher->loop, Loop, loop) &&
                    HAS_FIELDS(state, TimerState, timer)
                ? mailbox_of(self) == Py_None
                : -1;
  }
  if (usual > 0) {
    queue = (TimerQueue *)((WholeLoop *)loop)->timers;
    usual = is_first(queue, state) && is_ns(loop->now_ns, &now) &&
            is_ns(state->deadline_ns, &deadline) && is_ns(state->period_ns, &period);
  }
  if (usual <= 0) {
    Py_XDECREF(entry);
    return usual < 0 ? NULL : PyObject_CallMethod((PyObject *)self, "dispatch_any", NULL);
  }
  const uint64_t hash = dispatcher->recorder == Py_None ? 0 : hash_of_8((uint64_t)deadline);
  PyObject *cause[3] = {no_event, zero, PyLong_FromUnsignedLongLong(hash)};
  PyObject *next = next_deadline(now, deadline, period);
  PyObject *heap = Py_NewRef(queue->heap), *callback = Py_NewRef(self->callback);
  Py_INCREF(queue);
  /* Who holds all objects, as a profiler of memory may, makes these fail. */
  failed = next == NULL || cause[2] == NULL || PyTuple_SetItem(entry, 0, Py_NewRef(next)) < 0 ||
           PyTuple_SetItem(entry, 1, Py_NewRef(state->order)) < 0 ||
           PyTuple_SetItem(entry, 2, Py_NewRef((PyObject *)state)) < 0 ||
           set(&state->last_call_ns, Py_NewRef(loop->now_ns)) < 0 ||
           set(&state->deadline_ns, Py_NewRef(next)) < 0 ||
           set(&state->ticket, Py_NewRef(entry)) < 0 ||
           done(call_two(heapreplace, heap, entry)) < 0 ||
           find_first(queue, heap) < 0 || run_callback(self, TIMER, callback, no_args, 0, cause);
  Py_DECREF(queue);
  Py_DECREF(callback);
  Py_DECREF(heap);
  Py_XDECREF(next);
  Py_XDECREF(cause[2]);
  Py_DECREF(entry);
  return failed ? NULL : Py_NewRef(Py_None);
}

static PyMethodDef timer_methods[] = {
    {"dispatch", (PyCFunction)timer_dispatch, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

/* The fields of an entity, and the method of a publisher, subscription or timer. */
static PyTypeObject *entity_with(PyMethodDef *methods, const char *name) {
  PyType_Slot slots[] = {{Py_tp_methods, methods}, {0, NULL}};
  PyType_Spec spec = {
      name, sizeof(Entity), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE, slots,
  };
  if (entity_type == NULL) return NULL;
  return (PyTypeObject *)PyType_FromSpecWithBases(&spec, (PyObject *)entity_type);
}

static int add_types(PyObject *module) {
  PyObject *deque;
  deque_type = attribute_of("collections", "deque");
  deque = deque_type == NULL ? NULL : PyObject_CallObject(deque_type, NULL);
  if (deque == NULL) return -1;
  deque_append = function_of(PyObject_GetAttrString(deque, "append"), METH_O);
  deque_popleft = function_of(PyObject_GetAttrString(deque, "popleft"), METH_NOARGS);
  if (deque_append == NULL || deque_popleft == NULL)
    return PyErr_SetString(PyExc_ImportError, "a deque has other methods"), -1;
  hash64 = attribute_of("xxhash", "xxh3_64_intdigest");
  heapreplace = attribute_of("heapq", "heapreplace");
  no_event = PyLong_FromUnsignedLongLong(U64);
  no_args = PyTuple_New(0);
  zero = PyLong_FromLong(0);
  dispatch_name = PyUnicode_InternFromString("dispatch");
  callback_group = PyUnicode_InternFromString("callback_group");
  active_entity = PyUnicode_InternFromString("_active_entity");
  user_callback = PyUnicode_InternFromString("_callback");
  timer_callback = PyUnicode_InternFromString("callback");
  raw = PyUnicode_InternFromString("raw");
  admitted = PyUnicode_InternFromString("admitted");
  draw_kind = PyLong_FromLong(DRAW);
  no_sequence = PyLong_FromUnsignedLong(U32);
  buffer_type = (PyTypeObject *)PyType_FromSpec(&buffer_spec);
  chain_type = (PyTypeObject *)PyType_FromSpec(&chain_spec);
  event_type = event_made(event_fields, no_methods);
  dispatcher_type = dispatcher_made(dispatcher_fields, dispatcher_methods);
  entity_type = entity_made(entity_fields, no_methods);
  sites_type = sites_made(sites_fields, no_methods);
  timer_type = timer_made(timer_fields, no_methods);
  timers_type = timers_made(timers_fields, no_methods);
  subscription_type = entity_with(subscription_methods, "rsltrace._core.SubscriptionFields");
  if (PyErr_Occurred()) return -1;
  dispatch_usual = PyObject_GetAttr((PyObject *)subscription_type, dispatch_name);
  PyTypeObject *all[] = {
      buffer_type, chain_type, event_type, dispatcher_type, entity_type, sites_type, timer_type,
      timers_type, subscription_type,
      entity_with(publisher_methods, "rsltrace._core.PublisherFields"),
      entity_with(timer_methods, "rsltrace._core.TimerFields"),
  };
  if (PyErr_Occurred()) return -1;
  for (size_t i = 0; i < sizeof all / sizeof *all; ++i)
    if (PyModule_AddType(module, all[i]) < 0) return -1;
  return 0;
}

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_core", NULL, -1, NULL, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__core(void) {
  PyObject *module = PyModule_Create(&definition);
  if (module != NULL && (add_types(module) < 0 || add_loop_types(module) < 0 ||
                         add_message_plan(module) < 0 || add_turns(module) < 0))
    Py_CLEAR(module);
  return module;
}
