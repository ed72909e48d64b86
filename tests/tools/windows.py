"""Windows as far as a process of another system can pretend it: without what Python lacks there, and by its name.

What other packages do differently there is not pretended, so they are imported before.
"""

import _ctypes
import ctypes
import os
import shutil
import signal
import sys

LACKING = {
    os: "chown chroot ctermid fchown fork forkpty getegid geteuid getgid getgroups getloadavg getpgid getpgrp "
    "getpriority getresuid getsid getuid initgroups killpg lchown mkfifo mknod nice openpty posix_fadvise posix_spawn "
    "pread pwrite register_at_fork sched_getaffinity sched_setaffinity sched_yield sendfile setegid seteuid setgid "
    "setpgid setpriority setsid setuid statvfs sysconf tcgetpgrp ttyname wait3 wait4",
    signal: "SIGALRM SIGCHLD SIGCONT SIGHUP SIGKILL SIGPIPE SIGQUIT SIGSTOP SIGUSR1 SIGUSR2 alarm pause pthread_kill "
    "pthread_sigmask setitimer sigpending sigwait",
    _ctypes: "dlopen dlsym dlclose",
}
MODULES = ("crypt", "fcntl", "grp", "nis", "posix", "pty", "pwd", "resource", "readline", "syslog", "termios", "tty")


def pretend() -> None:
    """Pretend it from here on, in this process."""
    import gymnasium  # noqa: F401
    import rich.console  # noqa: F401
    import torch  # noqa: F401
    import tyro  # noqa: F401

    for module, names in LACKING.items():
        for name in names.split():
            vars(module).pop(name, None)
    sys.modules |= dict.fromkeys(MODULES)
    ctypes.c_long = ctypes.c_int32
    shutil.which = lambda name: name if os.path.isfile(name) else None  # the one there asks Windows
    sys.platform = "win32"
