"""The node that runs one-liners; the campaign adds them as functions below."""

# ruff: noqa
# mypy: ignore-errors

import _random
import _thread
import argparse
import array
import ast
import asyncio
import calendar
import collections
import concurrent.futures
import contextvars
import copy
import cProfile
import csv
import ctypes
import ctypes.util
import datetime
import decimal
import dis
import email.generator
import email.message
import email.mime.multipart
import email.utils
import enum
import fcntl
import filecmp
import functools
import gc
import getpass
import gettext
import glob
import grp
import gzip
import hashlib
import heapq
import hmac
import http.cookiejar
import http.server
import importlib.metadata
import importlib.util
import inspect
import io
import itertools
import json
import linecache
import locale
import logging
import marshal
import mimetypes
import mmap
import multiprocessing
import multiprocessing.shared_memory
import operator
import os
import pathlib
import pickle
import platform
import pprint
import pwd
import queue
import random
import re
import reprlib
import resource
import sched
import secrets
import select
import selectors
import shutil
import signal
import site
import socket
import sqlite3
import ssl
import statistics
import string
import struct
import subprocess
import symtable
import sys
import tempfile
import threading
import time
import timeit
import traceback
import tracemalloc
import types
import unittest.mock
import uuid
import warnings
import weakref
import xml.etree.ElementTree
import xmlrpc.client
import zipfile
import zlib

import numpy as np
from rclpy.node import Node
from std_msgs.msg import String

HERE = os.path.dirname(__file__)
LIBC = ctypes.CDLL(None)
BUFFER = ctypes.create_string_buffer(512)


class T:
    def __init__(self, name):
        self.name = name

    def __len__(self):
        return 1

    def say(self):
        return self.name


class Slim:
    __slots__ = ()


KEPT = T("kept")
MANY = [T(name) for name in "bacd"]


def zipped():
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a", "b")
    return file


def queue_waited():
    try:
        queue.Queue().get(timeout=0.02)
    except queue.Empty:
        return time.monotonic()


async def loop_time():
    return asyncio.get_running_loop().time()


async def a_task():
    task = asyncio.create_task(asyncio.sleep(0))
    await task
    return repr(task)


def a_coroutine():
    coroutine = loop_time()
    coroutine.close()
    return coroutine


async def later(number):
    await asyncio.sleep(random.random() / 100)
    return number


async def gathered():
    return await asyncio.gather(*map(later, range(5)))


async def all_tasks():
    kept = [asyncio.create_task(later(n)) for n in range(5)]
    return [task.get_coro().__name__ for task in asyncio.all_tasks()], len(kept)


async def raced():
    return [await one for one in asyncio.as_completed([later(n) for n in range(5)])]


def pooled():
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        calls = [pool.submit(pow, n, 2) for n in range(9)]
        return [one.result() for one in concurrent.futures.as_completed(calls)]


def threaded():
    found = []
    threads = [threading.Thread(target=found.append, args=(n,)) for n in range(9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def thread_ident():
    found = []
    thread = threading.Thread(target=lambda: found.append(threading.get_ident()))
    thread.start()
    thread.join()
    return found


def forked():
    child = os.fork()
    if not child:
        os._exit(0)
    os.waitpid(child, 0)
    return child


def multipart():
    message = email.mime.multipart.MIMEMultipart()
    message.attach(email.message.EmailMessage())
    return message.as_string()


def cProfiled():
    profile = cProfile.Profile()
    profile.runcall(sum, [1])
    return [entry.totaltime for entry in profile.getstats()]


def tracemalloc_peak():
    tracemalloc.start()
    kept = [T(str(n)) for n in range(100)]
    found = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return found


def warned():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warnings.warn(f"{Slim()}")
    return str(caught[0].message)


def pickled(obj):
    file = io.BytesIO()
    pickle.Pickler(file).dump(obj)
    return file.getvalue()


def sql(statement):
    return sqlite3.connect(":memory:").execute(statement).fetchall()


def defaulted():
    base = sqlite3.connect(":memory:")
    base.execute("create table t (n, a default current_timestamp)")
    base.execute("insert into t (n) values (1)")
    return base.execute("select * from t").fetchall()


class Lines(Node):
    def __init__(self):
        super().__init__("lines")
        self.given = self.create_publisher(String, "/given", 10)
        self.left = [name for name in globals() if name.startswith("line_")]
        self.left.sort(key=lambda name: int(name[5:]))
        self.create_timer(1.0, self.tick)

    def tick(self):
        if self.left:
            name = self.left.pop(0)
            try:
                text = globals()[name]()
            except Exception as error:
                text = f"{type(error).__name__}: {error}"
            self.given.publish(String(data=json.dumps([int(name[5:]), text])))
