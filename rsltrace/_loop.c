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
static PyObject *heappush, *heappop, *first_draw, *order_release, *minus_one;
static PyObject *next_ns_name, *destroyed_name, *popleft_name, *send_name;

FIELDS(WholeLoop, loop)
FIELDS(Link, link)

PyMemberDef loop_fields[] = {
    FIELD(Loop, now_ns, "now_ns"),
    FIELD(Loop, events, "events"),
    FIELD(Loop, activity_ns, "activity_ns"),
    FIELD(Loop, ready, "ready"),
    FIELD(WholeLoop, tasks, "tasks"),
    FIELD(WholeLoop, idle, "idle"),
    FIELD(WholeLoop, scheduled, "scheduled"),
    FIELD(WholeLoop, timers, "timers"),
    FIELD(WholeLoop, next_place, "next_place"),
    FIELD(WholeLoop, gate, "gate"),
    FIELD(WholeLoop, min_step_ns, "min_step_ns"),
    FIELD(WholeLoop, looks_at, "looks_at"),
    FIELD(WholeLoop, until_events, "_until_events"),
    FIELD(WholeLoop, quiet_ns, "_quiet_ns"),
    NO_FIELD,
};

static PyMemberDef link_fields[] = {
    FIELD(Link, subscription, "subscription"), FIELD(Link, loop, "_loop"),
    FIELD(Link, dispatcher, "_dispatcher"),    FIELD(Link, last_ns, "last_ns"),
    FIELD(Link, send, "send"),                 FIELD(Link, delay, "_delay"),
    FIELD(Link, arrive, "_arrives"),           NO_FIELD,
};

static int is_plain(PyObject *object) {
  return has_fields(object, link_type, &link_seen, link_fields, 0, FIELD_COUNT(Link));
}

static int is_loop(PyObject *object) {
  return has_fields(object, loop_type, &loop_seen, loop_fields, 0, FIELD_COUNT(WholeLoop));
}

/* -- links --------------------------------------------------------------------------------------- */

/* Whether a built-in method is the given one of a link. */
static int is_method(PyObject *method, PyObject *link, PyCFunction function) {
  return PyCFunction_Check(method) && PyCFunction_GetFunction(method) == function &&
         PyCFunction_GetSelf(method) == link;
}

/* Returns the receiver if it is ready now, else None. */
static PyObject *link_arrive(Link *self, PyObject *release) {
  PyObject *subscription, *destroyed, *receiver = NULL;
  int is_it;
  if (!is_plain((PyObject *)self)) return NULL;
  subscription = Py_NewRef(self->subscription);
  destroyed = PyObject_GetAttr(subscription, destroyed_name);
  is_it = destroyed == NULL ? -1 : PyObject_IsTrue(destroyed);
  Py_XDECREF(destroyed);
  if (is_it > 0) {
    receiver = Py_NewRef(Py_None);
  } else if (is_it == 0) {
    is_it = queue_arrival(subscription, release);
    if (is_it >= 0) receiver = Py_NewRef(is_it ? subscription : Py_None);
  }
  Py_DECREF(subscription);
  return receiver;
}

static PyObject *when_it_leaves(Link *self, WholeLoop *loop) {
  Dispatcher *dispatcher = (Dispatcher *)self->dispatcher;
  Event *event;
  int is_busy;
  if (!HAS_FIELDS(dispatcher, Dispatcher, dispatcher)) return NULL;
  event = (Event *)dispatcher->event;
  if (!HAS_FIELDS(event, Event, event)) return NULL;
  PyObject *busy_ns = Py_NewRef(event->busy_ns), *now_ns = Py_NewRef(loop->of_events.now_ns), *sum;
  is_busy = PyObject_IsTrue(busy_ns);
  sum = is_busy < 0 ? NULL : is_busy ? PyNumber_Add(now_ns, busy_ns) : Py_NewRef(now_ns);
  Py_DECREF(now_ns);
  Py_DECREF(busy_ns);
  return sum;
}

/* Draws a delay; sets it and the time of the arrival, which is not before the last one. */
static int draw_delay(Link *self, PyObject *leaves_ns, PyObject **delay_ns, PyObject **arrival_ns) {
  PyObject *sampler = Py_NewRef(self->delay), *last_ns;
  int is_early;
  *delay_ns = PyObject_CallFunctionObjArgs(sampler, leaves_ns, NULL);
  Py_DECREF(sampler);
  if (*delay_ns == NULL || !is_plain((PyObject *)self)) return -1;
  last_ns = Py_NewRef(self->last_ns);
  *arrival_ns = PyNumber_Add(leaves_ns, *delay_ns);
  is_early = *arrival_ns == NULL ? -1 : PyObject_RichCompareBool(*arrival_ns, last_ns, Py_LT);
  if (is_early > 0 && (set(arrival_ns, Py_NewRef(last_ns)) < 0 ||
                       set(delay_ns, PyNumber_Subtract(last_ns, leaves_ns)) < 0))
    is_early = -1;
  Py_DECREF(last_ns);
  return is_early < 0 ? -1 : set(&self->last_ns, Py_NewRef(*arrival_ns));
}

static int record_delay(Link *self, PyObject *delay_ns) {
  Dispatcher *dispatcher = (Dispatcher *)self->dispatcher;
  Entity *to = (Entity *)self->subscription;
  PyObject *recorder, *entity, *draw;
  int failed;
  if (!HAS_FIELDS(dispatcher, Dispatcher, dispatcher)) return -1;
  if (dispatcher->recorder == Py_None) return 0;
  if (!is_a((PyObject *)to, entity_type, &subscription_seen) || to->entity_id == NULL) {
    PyErr_SetString(PyExc_TypeError, "a subscription has no id");
    return -1;
  }
  recorder = Py_NewRef(dispatcher->recorder);
  entity = Py_NewRef(to->entity_id);
  draw = PyNumber_Or(first_draw, delay_ns);
  failed = draw == NULL || record_draw(recorder, entity, draw) < 0;
  Py_XDECREF(draw);
  Py_DECREF(entity);
  Py_DECREF(recorder);
  return failed ? -1 : 0;
}

static PyObject *release_of(Link *self, WholeLoop *loop, PyObject *arrival_ns,
                            PyObject *const *message) {
  PyObject *next_place = Py_NewRef(loop->next_place), *arrive = NULL, *release = NULL;
  PyObject *place = PyObject_CallObject(next_place, NULL);
  Py_DECREF(next_place);
  if (place != NULL && is_plain((PyObject *)self)) arrive = Py_NewRef(self->arrive);
  if (arrive != NULL) release = PyTuple_New(10); /* may collect garbage: see delivery_of */
  if (release != NULL) {
    PyTuple_SetItem(release, 0, Py_NewRef(arrival_ns));
    PyTuple_SetItem(release, 1, Py_NewRef(order_release));
    PyTuple_SetItem(release, 2, Py_NewRef(place));
    PyTuple_SetItem(release, 3, Py_NewRef(arrive));
    for (int i = 0; i < 6; ++i) PyTuple_SetItem(release, 4 + i, Py_NewRef(message[i]));
  }
  Py_XDECREF(arrive);
  Py_XDECREF(place);
  return release;
}

/* Whether a message has to wait in the loop's queue. */
static int is_later(Link *self, WholeLoop *loop, PyObject *delay_ns, PyObject *arrival_ns) {
  PyObject *arrive, *expects, *now_ns = Py_NewRef(loop->of_events.now_ns);
  int is_it = PyObject_IsTrue(delay_ns);
  if (is_it == 0) is_it = PyObject_RichCompareBool(arrival_ns, now_ns, Py_NE);
  Py_DECREF(now_ns);
  if (is_it || !is_plain((PyObject *)self)) return is_it ? is_it : -1;
  arrive = Py_NewRef(self->arrive);
  expects = PyObject_CallMethod((PyObject *)self, "expects", "O", arrive);
  Py_DECREF(arrive);
  is_it = expects == NULL ? -1 : PyObject_IsTrue(expects);
  Py_XDECREF(expects);
  return is_it;
}

static int enter(Link *self, WholeLoop *loop, PyObject *release, PyObject *delay_ns,
                 PyObject *arrival_ns) {
  PyObject *heap, *receiver;
  const int later = is_later(self, loop, delay_ns, arrival_ns);
  int failed;
  if (later < 0 || !is_loop((PyObject *)loop)) return -1;
  if (later) {
    heap = Py_NewRef(loop->scheduled);
    failed = done(PyObject_CallFunctionObjArgs(heappush, heap, release, NULL));
    Py_DECREF(heap);
    return failed;
  }
  receiver = link_arrive(self, release);
  if (receiver == NULL) return -1;
  failed = receiver != Py_None && (!is_loop((PyObject *)loop) ||
                                   append_to(loop->of_events.ready, receiver) < 0);
  Py_DECREF(receiver);
  return failed ? -1 : 0;
}

static int send_plainly(Link *self, PyObject *const *message) {
  PyObject *leaves_ns, *delay_ns = NULL, *arrival_ns = NULL, *release = NULL;
  WholeLoop *loop;
  int failed;
  if (!is_plain((PyObject *)self) || !is_loop(self->loop)) return -1;
  loop = (WholeLoop *)Py_NewRef(self->loop);
  leaves_ns = when_it_leaves(self, loop);
  failed = leaves_ns == NULL || !is_plain((PyObject *)self) ||
           draw_delay(self, leaves_ns, &delay_ns, &arrival_ns) < 0 ||
           !is_plain((PyObject *)self) || record_delay(self, delay_ns) < 0 ||
           !is_loop((PyObject *)loop);
  if (!failed) release = release_of(self, loop, arrival_ns, message);
  failed = release == NULL || !is_loop((PyObject *)loop) ||
           enter(self, loop, release, delay_ns, arrival_ns) < 0;
  Py_XDECREF(release);
  Py_XDECREF(arrival_ns);
  Py_XDECREF(delay_ns);
  Py_XDECREF(leaves_ns);
  Py_DECREF(loop);
  return failed ? -1 : 0;
}

static PyObject *link_send(Link *self, PyObject *const *args, Py_ssize_t count) {
  if (count != 6) {
    PyErr_Format(PyExc_TypeError, "send() got %zd arguments", count);
    return NULL;
  }
  return send_plainly(self, args) < 0 ? NULL : Py_NewRef(Py_None);
}

#define LINK_SEND ((PyCFunction)(void (*)(void))link_send)

int send_over(PyObject *link, PyObject *delivery) {
  PyObject *message[6], *send;
  int result;
  for (int i = 0; i < 6; ++i) message[i] = PyTuple_GetItem(delivery, 4 + i);
  if (is_a(link, link_type, &link_seen)) {
    send = ((Link *)link)->send;
    if (send != NULL && is_method(send, link, LINK_SEND)) return send_plainly((Link *)link, message);
  }
  send = PyObject_GetAttr(link, send_name);
  if (send == NULL) return -1;
  result = done(PyObject_CallFunctionObjArgs(send, message[0], message[1], message[2], message[3],
                                             message[4], message[5], NULL));
  Py_DECREF(send);
  return result;
}

static PyMethodDef link_methods[] = {
    {"send_delayed", LINK_SEND, METH_FASTCALL, NULL},
    {"arrive_delayed", (PyCFunction)link_arrive, METH_O, NULL},
    {NULL, NULL, 0, NULL},
};

/* -- time steps ---------------------------------------------------------------------------------- */

/* Returns a number, or 2**63 in place of more; -1 with an error. */
static __int128 number_of(PyObject *value) {
  int overflow;
  Py_XINCREF(value);
  const long long number = PyLong_AsLongLongAndOverflow(value, &overflow);
  Py_XDECREF(value);
  return overflow > 0 ? (__int128)INT64_MAX + 1 : number;
}

static Py_ssize_t size_of(PyObject *queue) {
  Py_ssize_t size;
  Py_XINCREF(queue);
  size = PyObject_Size(queue);
  Py_XDECREF(queue);
  return size;
}

/* Returns the time of the first release, borrowed; NULL if there is none, or with an error. */
static PyObject *first_ns(WholeLoop *self) {
  PyObject *first;
  if (!PyList_Check(self->scheduled)) {
    PyErr_SetString(PyExc_TypeError, "what is scheduled is no list");
    return NULL;
  }
  if (PyList_Size(self->scheduled) == 0) return NULL;
  first = PyList_GetItem(self->scheduled, 0);
  return PyTuple_Check(first) && PyTuple_Size(first) > 3
             ? PyTuple_GetItem(first, 0)
             : (PyErr_SetString(PyExc_TypeError, "what is scheduled is no release"), NULL);
}

static __int128 next_timer_ns(WholeLoop *self) {
  PyObject *timers = Py_NewRef(self->timers);
  PyObject *value = PyObject_GetAttr(timers, next_ns_name);
  const __int128 next_ns = value == NULL ? -1 : number_of(value);
  Py_XDECREF(value);
  Py_DECREF(timers);
  return next_ns;
}

/* Whether the next arrival is all that the loop has to look at; -1 with an error. */
static int is_next(WholeLoop *self) {
  PyObject *time = first_ns(self);
  __int128 next_ns, timer_ns;
  Py_ssize_t others;
  if (time == NULL) return PyErr_Occurred() ? -1 : 0;
  next_ns = number_of(time);
  if (next_ns == -1 && PyErr_Occurred()) return -1;
  others = size_of(self->of_events.ready);
  if (others == 0) others = size_of(self->tasks);
  if (others == 0) others = size_of(self->idle);
  if (others) return others < 0 ? -1 : 0;
  if (self->gate != Py_None) return 0;
  if (next_ns <= number_of(self->of_events.now_ns) || next_ns >= number_of(self->quiet_ns) ||
      number_of(self->of_events.events) >= number_of(self->until_events) ||
      number_of(self->min_step_ns) != 0 || PyErr_Occurred() || !is_loop((PyObject *)self))
    return PyErr_Occurred() ? -1 : 0;
  timer_ns = next_timer_ns(self);
  return PyErr_Occurred() ? -1 : next_ns < timer_ns;
}

static PyObject *receiver_of(PyObject *release) {
  PyObject *function = Py_NewRef(PyTuple_GetItem(release, 3)), *owner, *receiver;
  owner = PyCFunction_Check(function) ? PyCFunction_GetSelf(function) : NULL;
  if (owner != NULL && is_method(function, owner, (PyCFunction)link_arrive))
    receiver = link_arrive((Link *)owner, release);
  else
    receiver = PyObject_CallFunctionObjArgs(function, release, NULL);
  Py_DECREF(function);
  return receiver;
}

/* Lets the arrival and the others of its time be dispatched in order; returns who is next. */
static PyObject *first_ready(WholeLoop *self, PyObject *receiver) {
  PyObject *ready = Py_NewRef(self->of_events.ready), *time = first_ns(self), *first = NULL;
  const int is_due =
      time == NULL ? 0 : number_of(time) <= number_of(self->of_events.now_ns);
  if (!PyErr_Occurred()) {
    if (is_due)
      first = receiver != Py_None && append_to(ready, receiver) < 0 ? NULL : Py_NewRef(Py_None);
    else if (receiver != Py_None || PyObject_Size(ready) <= 0)
      first = PyErr_Occurred() ? NULL : Py_NewRef(receiver);
    else
      first = PyObject_CallMethodObjArgs(ready, popleft_name, NULL);
  }
  Py_DECREF(ready);
  return first;
}

static PyObject *loop_next_arrival(WholeLoop *self, PyObject *Py_UNUSED(none)) {
  PyObject *heap, *release, *receiver, *first = NULL;
  const int is_it = is_loop((PyObject *)self) ? is_next(self) : -1;
  if (is_it <= 0) return is_it < 0 ? NULL : Py_NewRef(Py_False);
  if (!is_loop((PyObject *)self)) return NULL;
  heap = Py_NewRef(self->scheduled);
  release = PyObject_CallFunctionObjArgs(heappop, heap, NULL);
  Py_DECREF(heap);
  if (release == NULL) return NULL;
  if (!PyTuple_Check(release) || PyTuple_Size(release) < 4) {
    PyErr_SetString(PyExc_TypeError, "what is scheduled is no release");
  } else if (set(&self->of_events.now_ns, Py_NewRef(PyTuple_GetItem(release, 0))) == 0 &&
             set(&self->looks_at, Py_NewRef(minus_one)) == 0) {
    receiver = receiver_of(release);
    if (receiver != NULL && is_loop((PyObject *)self)) first = first_ready(self, receiver);
    Py_XDECREF(receiver);
  }
  Py_DECREF(release);
  return first;
}

static PyMethodDef loop_methods[] = {
    {"next_arrival", (PyCFunction)loop_next_arrival, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

int add_loop_types(PyObject *module) {
  heappush = attribute_of("heapq", "heappush");
  heappop = attribute_of("heapq", "heappop");
  order_release = PyLong_FromLong(1);
  first_draw = PyLong_FromLongLong(DELAY);
  minus_one = PyLong_FromLong(-1);
  next_ns_name = PyUnicode_InternFromString("next_ns");
  destroyed_name = PyUnicode_InternFromString("destroyed");
  popleft_name = PyUnicode_InternFromString("popleft");
  send_name = PyUnicode_InternFromString("send");
  loop_type = loop_made(loop_fields, loop_methods);
  link_type = link_made(link_fields, link_methods);
  if (heappush == NULL || heappop == NULL || first_draw == NULL || order_release == NULL ||
      minus_one == NULL || next_ns_name == NULL || destroyed_name == NULL || popleft_name == NULL ||
      send_name == NULL || loop_type == NULL || link_type == NULL ||
      PyModule_AddObjectRef(module, "LoopFields", (PyObject *)loop_type) < 0)
    return -1;
  return PyModule_AddObjectRef(module, "LinkFields", (PyObject *)link_type);
}
