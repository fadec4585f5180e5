/* Delays, compiled: a message on its way over a link that only delays and keeps the order, and the
   loop's time steps with one arrival. What loop.py's next_arrival and links.py's fast_send do. */

#include "_core.h"

#define DELAY (1LL << 56) /* encode_decision(RandomDecision.DELAY) */

typedef struct {
  PyObject_HEAD
  PyObject *subscription, *loop, *dispatcher, *last_ns, *send, *delay, *arrive;
} Link; /* the last two only if it sends with link_send */

PyTypeObject *loop_type;
static PyTypeObject *link_type;
static PyObject *link_seen;
static PyObject *heappush, *heappop, *order_release, *minus_one;
static PyObject *send_name;

FIELDS(WholeLoop, loop, "LoopFields")
FIELDS(Link, link, "LinkFields")

PyMemberDef loop_fields[] = {
    FIELD(Loop, now_ns, "now_ns"), FIELD(Loop, events, "events"),
    FIELD(Loop, activity_ns, "activity_ns"), FIELD(Loop, ready, "ready"),
    FIELD(WholeLoop, tasks, "tasks"), FIELD(WholeLoop, idle, "idle"),
    FIELD(WholeLoop, scheduled, "scheduled"), FIELD(WholeLoop, timers, "timers"),
    FIELD(WholeLoop, places, "places"), FIELD(WholeLoop, gate, "gate"),
    FIELD(WholeLoop, min_step_ns, "min_step_ns"), FIELD(WholeLoop, looks_at, "looks_at"),
    FIELD(WholeLoop, until_events, "_until_events"), FIELD(WholeLoop, quiet_ns, "_quiet_ns"),
    FIELD(WholeLoop, interrupt, "_interrupt"), NO_FIELD,
};

static PyMemberDef link_fields[] = {
    FIELD(Link, subscription, "subscription"), FIELD(Link, loop, "_loop"),
    FIELD(Link, dispatcher, "_dispatcher"),    FIELD(Link, last_ns, "last_ns"),
    FIELD(Link, send, "send"),                 FIELD(Link, delay, "_delay"),
    FIELD(Link, arrive, "_arrives"),           NO_FIELD,
};

/* -- links --------------------------------------------------------------------------------------- */

/* Returns the receiver if it is ready now, else None. */
static PyObject *link_arrive(Link *self, PyObject *release) {
  PyObject *to, *receiver = NULL;
  int is_it = 0;
  if (!HAS_FIELDS(self, Link, link)) return NULL;
  to = Py_NewRef(self->subscription);
  if (!is_a(to, entity_type, &subscription_seen) || ((Entity *)to)->destroyed != Py_True)
    is_it = queue_arrival(to, release);
  if (is_it >= 0) receiver = Py_NewRef(is_it ? to : Py_None);
  Py_DECREF(to);
  return receiver;
}

/* What sending reads, held, as any code of Python may replace it. */
enum { ENTITY_ID, RECORDER, SAMPLER, ARRIVE, PLACES, HEAP, HELD };

static int hold(Link *self, PyObject **held, uint64_t *leaves_ns) {
  uint64_t now_ns, busy_ns;
  if (!HAS_FIELDS(self, Link, link) || !HAS_FIELDS(self->loop, WholeLoop, loop) ||
      !HAS_FIELDS(self->dispatcher, Dispatcher, dispatcher))
    return -1;
  const WholeLoop *loop = (WholeLoop *)self->loop;
  const Dispatcher *dispatcher = (Dispatcher *)self->dispatcher;
  const Event *event = (Event *)dispatcher->event;
  const Entity *to = (Entity *)self->subscription;
  if (!HAS_FIELDS(event, Event, event) || read_number(loop->of_events.now_ns, &now_ns) < 0 ||
      read_number(event->busy_ns, &busy_ns) < 0)
    return -1;
  if (!is_a(self->subscription, entity_type, &subscription_seen) || to->entity_id == NULL) {
    PyErr_SetString(PyExc_TypeError, "a subscription has no id");
    return -1;
  }
  *leaves_ns = now_ns + busy_ns;
  PyObject *all[HELD] = {
      [ENTITY_ID] = to->entity_id,
      [RECORDER] = dispatcher->recorder,
      [SAMPLER] = self->delay,
      [ARRIVE] = self->arrive,
      [PLACES] = loop->places,
      [HEAP] = loop->scheduled,
  };
  for (int i = 0; i < HELD; ++i) held[i] = Py_NewRef(all[i]);
  return 0;
}

/* Draws a delay. What is drawn whatever the time is an iterator (distribution.Draws). */
static int draw(PyObject *sampler, uint64_t leaves_ns, uint64_t *delay_ns) {
  PyObject *drawn = PyIter_Check(sampler) ? PyIter_Next(sampler)
                                          : PyObject_CallFunction(sampler, "K", leaves_ns);
  const int failed = drawn == NULL || read_number(drawn, delay_ns) < 0;
  Py_XDECREF(drawn);
  if (failed && !PyErr_Occurred()) PyErr_SetNone(PyExc_StopIteration);
  return -failed;
}

static PyObject *release_of(PyObject *const *held, PyObject *arrival_ns,
                            PyObject *const *message) {
  PyObject *place = PyIter_Check(held[PLACES]) ? PyIter_Next(held[PLACES]) : NULL, *release;
  if (place == NULL) {
    if (!PyErr_Occurred()) PyErr_SetString(PyExc_TypeError, "the loop has no places");
    return NULL;
  }
  release = PyTuple_Pack(10, arrival_ns, order_release, place, held[ARRIVE], message[0],
                         message[1], message[2], message[3], message[4], message[5]);
  Py_DECREF(place);
  return release;
}

static int send_plainly(Link *self, PyObject *const *message) {
  PyObject *held[HELD], *number = NULL, *release = NULL;
  uint64_t leaves_ns, delay_ns, arrival_ns, last_ns;
  int failed;
  if (hold(self, held, &leaves_ns) < 0) return -1;
  failed = draw(held[SAMPLER], leaves_ns, &delay_ns) < 0 || !HAS_FIELDS(self, Link, link) ||
           read_number(self->last_ns, &last_ns) < 0;
  if (!failed) {
    arrival_ns = leaves_ns + delay_ns < last_ns ? last_ns : leaves_ns + delay_ns;
    delay_ns = arrival_ns - leaves_ns;
    number = PyLong_FromUnsignedLongLong(arrival_ns);
    failed = set(&self->last_ns, Py_XNewRef(number)) < 0 ||
             (held[RECORDER] != Py_None &&
              record_draw(held[RECORDER], held[ENTITY_ID], DELAY | delay_ns) < 0);
  }
  if (!failed) release = release_of(held, number, message);
  failed = release == NULL || /* what takes no time is rare, and left to Python */
           done(delay_ns ? call_two(heappush, held[HEAP], release)
                         : PyObject_CallMethod((PyObject *)self, "enter", "(O)", release)) < 0;
  Py_XDECREF(release);
  Py_XDECREF(number);
  for (int i = 0; i < HELD; ++i) Py_DECREF(held[i]);
  return -failed;
}

static PyObject *link_send(Link *self, PyObject *const *args, Py_ssize_t count) {
  if (check_count("send", count, 6, 6) < 0 || send_plainly(self, args) < 0) return NULL;
  Py_RETURN_NONE;
}

int send_over(PyObject *link, PyObject *const *message) {
  PyObject *send;
  int result;
  if (is_a(link, link_type, &link_seen) && ((Link *)link)->delay != NULL)
    return send_plainly((Link *)link, message);
  send = PyObject_GetAttr(link, send_name);
  if (send == NULL) return -1;
  result = done(PyObject_CallFunctionObjArgs(send, message[0], message[1], message[2], message[3],
                                             message[4], message[5], NULL));
  Py_DECREF(send);
  return result;
}

static PyMethodDef link_methods[] = {
    {"send_delayed", (PyCFunction)(void (*)(void))link_send, METH_FASTCALL, NULL},
    {"arrive_delayed", (PyCFunction)link_arrive, METH_O, NULL},
    {NULL, NULL, 0, NULL},
};

/* -- time steps ---------------------------------------------------------------------------------- */

enum { NOW, NEXT, TIMER, QUIET, EVENTS, UNTIL, STEP, NUMBERS };

/* Whether the next arrival is all that the loop has to look at; -1 if only Python can tell. It runs
   no code of Python: there are only lists, deques and whole numbers. */
static int is_next(const WholeLoop *self) {
  const TimerQueue *timers = (TimerQueue *)self->timers;
  PyObject *ready = self->of_events.ready, *first;
  int64_t numbers[NUMBERS];
  if ((PyObject *)Py_TYPE(ready) != deque_type || (PyObject *)Py_TYPE(self->tasks) != deque_type ||
      !PyList_CheckExact(self->idle) || !PyList_CheckExact(self->scheduled) ||
      !is_a(self->timers, timers_type, &timers_seen) || timers->next_ns == NULL)
    return -1;
  if (PyList_Size(self->scheduled) == 0 || PyObject_Size(ready) || PyObject_Size(self->tasks) ||
      PyList_Size(self->idle) || self->gate != Py_None)
    return 0;
  first = PyList_GetItem(self->scheduled, 0);
  if (!PyTuple_CheckExact(first) || PyTuple_Size(first) < 4) return -1;
  PyObject *all[NUMBERS] = {
      [NOW] = self->of_events.now_ns,    [NEXT] = PyTuple_GetItem(first, 0),
      [TIMER] = timers->next_ns,         [QUIET] = self->quiet_ns,
      [EVENTS] = self->of_events.events, [UNTIL] = self->until_events,
      [STEP] = self->min_step_ns,
  };
  for (int i = 0; i < NUMBERS; ++i) {
    int overflow;
    if (!PyLong_CheckExact(all[i])) return -1;
    numbers[i] = PyLong_AsLongLongAndOverflow(all[i], &overflow);
    if (overflow) numbers[i] = overflow > 0 ? INT64_MAX : INT64_MIN;
  }
  if (numbers[NEXT] == INT64_MAX) return -1;
  return numbers[NOW] < numbers[NEXT] && numbers[NEXT] < numbers[TIMER] &&
         numbers[NEXT] < numbers[QUIET] && numbers[EVENTS] < numbers[UNTIL] && numbers[STEP] == 0;
}

static PyObject *receiver_of(PyObject *release) {
  PyObject *function = Py_XNewRef(PyTuple_GetItem(release, 3));
  PyObject *receiver = function == NULL ? NULL : call_one(function, release);
  Py_XDECREF(function);
  return receiver;
}

/* Whether another release is due; -1 with an error. */
static int is_due(const WholeLoop *self) {
  const Py_ssize_t count = PyList_Size(self->scheduled);
  PyObject *first;
  uint64_t first_ns, now_ns;
  if (count <= 0) return (int)count;
  first = PyTuple_GetItem(PyList_GetItem(self->scheduled, 0), 0);
  if (first == NULL || read_number(first, &first_ns) < 0 ||
      read_number(self->of_events.now_ns, &now_ns) < 0)
    return -1;
  return first_ns <= now_ns;
}

/* Lets the arrival and the others of its time be dispatched in order; returns who is next. */
static PyObject *first_ready(WholeLoop *self, PyObject *receiver) {
  PyObject *ready = Py_NewRef(self->of_events.ready), *first = NULL;
  const int due = is_due(self);
  if (due > 0)
    first = receiver != Py_None && append_to(ready, receiver) < 0 ? NULL : Py_NewRef(Py_None);
  else if (due == 0 && (receiver != Py_None || PyObject_Size(ready) <= 0))
    first = PyErr_Occurred() ? NULL : Py_NewRef(receiver);
  else if (due == 0)
    first = PyObject_CallMethod(ready, "popleft", NULL);
  Py_DECREF(ready);
  return first;
}

static PyObject *loop_next_arrival(WholeLoop *self, PyObject *Py_UNUSED(none)) {
  PyObject *heap, *release, *receiver, *first = NULL;
  if (!HAS_FIELDS(self, WholeLoop, loop)) return NULL;
  const int is_it = is_next(self);
  if (is_it < 0) return PyObject_CallMethod((PyObject *)self, "python_next_arrival", NULL);
  if (!is_it) return Py_NewRef(Py_False);
  heap = Py_NewRef(self->scheduled);
  release = call_one(heappop, heap);
  Py_DECREF(heap);
  if (release == NULL) return NULL;
  if (set(&self->of_events.now_ns, Py_XNewRef(PyTuple_GetItem(release, 0))) == 0 &&
      set(&self->looks_at, Py_NewRef(minus_one)) == 0) {
    receiver = receiver_of(release);
    if (receiver != NULL && HAS_FIELDS(self, WholeLoop, loop)) first = first_ready(self, receiver);
    Py_XDECREF(receiver);
  }
  Py_DECREF(release);
  return first;
}

/* Dispatches time steps with one arrival; returns when the last one was, or else what it is given. */
static PyObject *loop_run_arrivals(WholeLoop *self, PyObject *now_ns) {
  PyObject *item = loop_next_arrival(self, NULL);
  int failed = 0;
  Py_INCREF(now_ns);
  while (!failed && item != NULL && item != Py_False) {
    failed = !HAS_FIELD(self, Loop, loop, now_ns) ||
             set(&now_ns, Py_NewRef(self->of_events.now_ns)) < 0 ||
             (item != Py_None && dispatch(item) < 0);
    Py_DECREF(item);
    item = failed ? NULL : loop_next_arrival(self, NULL);
  }
  if (item == NULL) Py_CLEAR(now_ns);
  Py_XDECREF(item);
  return now_ns;
}

/* Dispatches tasks, and what is ready, until none is left or ``limit`` events have run. */
static PyObject *loop_run_ready(WholeLoop *self, PyObject *limit) {
  int failed = 0;
  while (!failed && HAS_FIELDS(self, WholeLoop, loop)) {
    PyObject *tasks = self->tasks, *ready = self->of_events.ready, *item;
    uint64_t events, most;
    if ((PyObject *)Py_TYPE(ready) != deque_type || (PyObject *)Py_TYPE(tasks) != deque_type)
      return PyObject_CallMethod((PyObject *)self, "python_run_ready", "(O)", limit);
    if (read_number(self->of_events.events, &events) < 0 || read_number(limit, &most) < 0) break;
    if (PyObject_Size(tasks)) ready = tasks;
    if (self->interrupt != Py_False || events >= most || PyObject_Size(ready) == 0) Py_RETURN_NONE;
    item = deque_popleft(ready, NULL);
    failed = set(&self->looks_at, Py_NewRef(limit)) < 0 || item == NULL || dispatch(item) < 0;
    Py_XDECREF(item);
  }
  return NULL;
}

static PyMethodDef loop_methods[] = {
    {"run_arrivals", (PyCFunction)loop_run_arrivals, METH_O, NULL},
    {"run_ready", (PyCFunction)loop_run_ready, METH_O, NULL},
    {"next_arrival", (PyCFunction)loop_next_arrival, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

int add_loop_types(PyObject *module) {
  heappush = attribute_of("heapq", "heappush");
  heappop = attribute_of("heapq", "heappop");
  order_release = PyLong_FromLong(1);
  minus_one = PyLong_FromLong(-1);
  send_name = PyUnicode_InternFromString("send");
  loop_type = loop_made(loop_fields, loop_methods);
  link_type = link_made(link_fields, link_methods);
  if (PyErr_Occurred() || PyModule_AddType(module, loop_type) < 0) return -1;
  return PyModule_AddType(module, link_type);
}
