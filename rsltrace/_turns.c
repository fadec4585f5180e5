/* Whose turn it is, of a process and the loop, in memory that both see: see turns.h of
   adapters/processes/native. Who waits for a short time only spins, and need not be woken. */

#include "_core.h"

#include <sys/mman.h>

typedef struct {
  uint64_t length;
  uint32_t batches, loop_sleeps, turns, process_sleeps, may_spin;
} Shared;

typedef struct {
  Shared *shared;
  uint32_t taken;        /* batches */
  uint32_t rests, pause; /* how often it does not spin now, and after the next time in vain */
  int is_awake;          /* the process, when it was given its last turn */
} Turns;

enum { SPINS = 1500, PAUSE_MAX = 1024 }; /* about 30 us; turns */

#if defined(__x86_64__)
#define RELAX() __builtin_ia32_pause()
#elif defined(__aarch64__)
#define RELAX() __asm__ volatile("isb" ::: "memory")
#else
#define RELAX() ((void)0)
#endif

static void turns_forget(PyObject *capsule) {
  Turns *turns = PyCapsule_GetPointer(capsule, NULL);
  munmap(turns->shared, sizeof(Shared));
  PyMem_Free(turns);
}

/* Return what follows the turns of the process that shares a file. */
static PyObject *turns_of(PyObject *Py_UNUSED(self), PyObject *fd) {
  const long file = PyLong_AsLong(fd);
  if (file == -1 && PyErr_Occurred()) return NULL;
  void *shared = mmap(NULL, sizeof(Shared), PROT_READ | PROT_WRITE, MAP_SHARED, (int)file, 0);
  if (shared == MAP_FAILED) return PyErr_SetFromErrno(PyExc_OSError);
  Turns *turns = PyMem_Calloc(1, sizeof *turns);
  PyObject *capsule = turns == NULL ? PyErr_NoMemory() : PyCapsule_New(turns, NULL, turns_forget);
  if (capsule == NULL) return munmap(shared, sizeof(Shared)), PyMem_Free(turns), NULL;
  turns->shared = shared;
  turns->shared->may_spin = 1;
  return capsule;
}

/* Give the process a turn; return whether it sleeps and must be woken. */
static PyObject *turn_given(PyObject *Py_UNUSED(self), PyObject *capsule) {
  Turns *turns = PyCapsule_GetPointer(capsule, NULL);
  if (turns == NULL) return NULL;
  __atomic_add_fetch(&turns->shared->turns, 1, __ATOMIC_SEQ_CST);
  turns->is_awake = !__atomic_exchange_n(&turns->shared->process_sleeps, 0, __ATOMIC_SEQ_CST);
  return PyBool_FromLong(!turns->is_awake);
}

/* Return whether there is a batch, if need be after some time; if not, the process will ring. */
static PyObject *turn_over(PyObject *Py_UNUSED(self), PyObject *capsule) {
  Turns *turns = PyCapsule_GetPointer(capsule, NULL);
  if (turns == NULL) return NULL;
  uint32_t *batches = &turns->shared->batches;
  int left = turns->is_awake && turns->rests == 0 ? SPINS : 0;
  const int spins = left > 0;
  turns->rests -= turns->rests > 0;
  turns->is_awake = 0; /* a second look has slept */
  Py_BEGIN_ALLOW_THREADS;
  for (; __atomic_load_n(batches, __ATOMIC_ACQUIRE) == turns->taken && left > 0; --left) RELAX();
  Py_END_ALLOW_THREADS;
  if (spins && left > 0) turns->pause /= 2;
  if (spins && left == 0)
    turns->rests = turns->pause = turns->pause < PAUSE_MAX ? 2 * turns->pause + 1 : PAUSE_MAX;
  __atomic_store_n(&turns->shared->loop_sleeps, 1, __ATOMIC_SEQ_CST);
  if (__atomic_load_n(batches, __ATOMIC_SEQ_CST) == turns->taken) return PyBool_FromLong(0);
  __atomic_store_n(&turns->shared->loop_sleeps, 0, __ATOMIC_RELAXED);
  ++turns->taken;
  return PyBool_FromLong(1);
}

static PyMethodDef functions[] = {
    {"turns_of", turns_of, METH_O, NULL},
    {"turn_given", turn_given, METH_O, NULL},
    {"turn_over", turn_over, METH_O, NULL},
    {NULL, NULL, 0, NULL},
};

int add_turns(PyObject *module) { return PyModule_AddFunctions(module, functions); }
