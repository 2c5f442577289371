"""Names that a function of generated C must not have. No torch in here.

The rule is complete in what it covers: keywords of C (to C23) and C++ (to C++23), with their alternative tokens; what
the C standard (C11, 7.1.3) and POSIX (XSH 2.2.2) reserve in any program, by pattern; every function and lower-case
macro that the headers of C11 and of POSIX.1-2017 declare, and those that glibc adds to ``math.h``, ``stdio.h``,
``stdlib.h`` and ``string.h``, whichever the generated code includes: a function of such a name takes the library's
place for the whole program. Left out are the patterns that C reserves for libraries of the future (``is``, ``to``,
``str``, ``mem`` and a lower-case letter): they would refuse ``torque`` and ``stress``, which no library has.
"""

from __future__ import annotations

import re

_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_RESERVED = re.compile(
    r".*__.*|.*_t|casadi.*|CASADI.*|CODEGEN.*|FLOAT\w*"
    r"|(?:E[0-9A-Z]|FE_|FP_|U?INT\w*_|LC_|PRI[a-zX]|SCN[a-zX]|SIG|MB_|M_|DBL_|FLT_|LDBL_|SEEK_|EXIT_|ATOMIC_|HUGE_|F_|O_"
    r"|RTLD_|S_|W[A-Z]|CPU_|FD_|NL_|PTHREAD|L_|P_|SNAN)\w*|[a-z]\w*f(?:16|32|64|128)x?"
)
"""Double underscores; types; CasADi's own; macros of the headers; functions of fixed formats (``sinf32``)."""
MOST = 200
"""Longest name: files are called after it."""
_KEYWORDS = """
alignas alignof and and_eq asm atomic_cancel atomic_commit atomic_noexcept auto bitand bitor bool break case
catch char char16_t char32_t char8_t class co_await co_return co_yield compl concept const const_cast
consteval constexpr constinit continue decltype default delete do double dynamic_cast else enum explicit
export extern false float for friend goto if inline int long mutable namespace new noexcept not not_eq nullptr
operator or or_eq private protected public reflexpr register reinterpret_cast requires restrict return short
signed sizeof static static_assert static_cast struct switch synchronized template this thread_local throw
true try typedef typeid typename typeof typeof_unqual union unsigned using virtual void volatile wchar_t while
xor xor_eq
"""
_LIBRARY = """
a64l abort abs accept access acos acosf acosh acoshf acoshl acosl aio_cancel aio_error aio_fsync aio_read
aio_return aio_suspend aio_write alarm aligned_alloc alloca alphasort arc4random arc4random_buf
arc4random_uniform asctime asctime_r asin asinf asinh asinhf asinhl asinl asprintf assert at_quick_exit atan
atan2 atan2f atan2l atanf atanh atanhf atanhl atanl atexit atof atoi atol atoll atomic_compare_exchange_strong
atomic_compare_exchange_strong_explicit atomic_compare_exchange_weak atomic_compare_exchange_weak_explicit
atomic_exchange atomic_exchange_explicit atomic_fetch_add atomic_fetch_add_explicit atomic_fetch_and
atomic_fetch_and_explicit atomic_fetch_or atomic_fetch_or_explicit atomic_fetch_sub atomic_fetch_sub_explicit
atomic_fetch_xor atomic_fetch_xor_explicit atomic_flag_clear atomic_flag_clear_explicit
atomic_flag_test_and_set atomic_flag_test_and_set_explicit atomic_init atomic_is_lock_free atomic_load
atomic_load_explicit atomic_signal_fence atomic_store atomic_store_explicit atomic_thread_fence basename bcmp
bcopy be16toh be32toh be64toh bind bsearch btowc BUFSIZ bzero c16rtomb c32rtomb cabs cabsf cabsl cacos cacosf
cacosh cacoshf cacoshl cacosl call_once calloc canonicalize canonicalize_file_name canonicalizef canonicalizel
carg cargf cargl casin casinf casinh casinhf casinhl casinl catan catanf catanh catanhf catanhl catanl
catclose catgets catopen cbrt cbrtf cbrtl ccos ccosf ccosh ccoshf ccoshl ccosl ceil ceilf ceill cexp cexpf
cexpl cfgetispeed cfgetospeed cfsetispeed cfsetospeed chdir chmod chown cimag cimagf cimagl clearenv clearerr
clearerr_unlocked clock clock_getcpuclockid clock_getres clock_gettime clock_nanosleep clock_settime clog
clogf clogl close closedir closelog cnd_broadcast cnd_destroy cnd_init cnd_signal cnd_timedwait cnd_wait
complex confstr conj conjf conjl connect copysign copysignf copysignl cos cosf cosh coshf coshl cosl cpow
cpowf cpowl cproj cprojf cprojl creal crealf creall creat csin csinf csinh csinhf csinhl csinl csqrt csqrtf
csqrtl ctan ctanf ctanh ctanhf ctanhl ctanl ctermid ctime ctime_r cuserid daddl daylight ddivl dfmal difftime
dirfd dirname div dlclose dlerror DllMain dlopen dlsym dmull dprintf drand48 drand48_r drem dremf dreml dsqrtl
dsubl dup dup2 ecvt ecvt_r endgrent endhostent endnetent endprotoent endpwent endservent endutxent environ
erand48 erand48_r erf erfc erfcf erfcl erff erfl errno execl execle execlp execv execve execvp exit exp exp10
exp10f exp10l exp2 exp2f exp2l expf expl explicit_bzero expm1 expm1f expm1l fabs fabsf fabsl faccessat fadd
faddl far fchdir fchmod fchmodat fchown fchownat fclose fcloseall fcntl fcvt fcvt_r fdatasync fdim fdimf fdiml
fdiv fdivl fdopen fdopendir feclearexcept fegetenv fegetexceptflag fegetround feholdexcept feof feof_unlocked
feraiseexcept ferror ferror_unlocked fesetenv fesetexceptflag fesetround fetestexcept feupdateenv fexecve
fflush fflush_unlocked ffma ffmal ffs ffsl ffsll fgetc fgetc_unlocked fgetpos fgetpos64 fgets fgets_unlocked
fgetwc fgetws FILENAME_MAX fileno fileno_unlocked finite finitef finitel flockfile floor floorf floorl fma
fmaf fmal fmax fmaxf fmaximum fmaximum_mag fmaximum_mag_num fmaximum_mag_numf fmaximum_mag_numl fmaximum_magf
fmaximum_magl fmaximum_num fmaximum_numf fmaximum_numl fmaximumf fmaximuml fmaxl fmaxmag fmaxmagf fmaxmagl
fmemopen fmin fminf fminimum fminimum_mag fminimum_mag_num fminimum_mag_numf fminimum_mag_numl fminimum_magf
fminimum_magl fminimum_num fminimum_numf fminimum_numl fminimumf fminimuml fminl fminmag fminmagf fminmagl
fmod fmodf fmodl fmtmsg fmul fmull fnmatch fopen fopen64 FOPEN_MAX fopencookie fork fortran fpathconf
fpclassify fprintf fputc fputc_unlocked fputs fputs_unlocked fputwc fputws fread fread_unlocked free
freeaddrinfo freopen freopen64 frexp frexpf frexpl fromfp fromfpf fromfpl fromfpx fromfpxf fromfpxl fscanf
fseek fseeko fseeko64 fsetpos fsetpos64 fsqrt fsqrtl fstat fstatat fstatvfs fsub fsubl fsync ftell ftello
ftello64 ftok ftruncate ftrylockfile ftw funlockfile futimens fwide fwprintf fwrite fwrite_unlocked fwscanf
gai_strerror gamma gammaf gammal gcvt getaddrinfo getc getc_unlocked getchar getchar_unlocked getcwd getdate
getdelim getegid getenv geteuid getgid getgrent getgrgid getgrgid_r getgrnam getgrnam_r getgroups
gethostbyaddr gethostbyname gethostent gethostid gethostname getitimer getline getloadavg getlogin getlogin_r
getnameinfo getnetbyaddr getnetbyname getnetent getopt getpayload getpayloadf getpayloadl getpeername getpgid
getpgrp getpid getppid getpriority getprotobyname getprotobynumber getprotoent getpt getpwent getpwnam
getpwnam_r getpwuid getpwuid_r getrlimit getrusage getservbyname getservbyport getservent getsid getsockname
getsockopt getsubopt gettimeofday getuid getutxent getutxid getutxline getw getwc getwchar glob globfree
gmtime gmtime_r grantpt hcreate hdestroy hsearch htobe16 htobe32 htobe64 htole16 htole32 htole64 htonl htons
hypot hypotf hypotl iconv iconv_close iconv_open if_freenameindex if_indextoname if_nameindex if_nametoindex
ilogb ilogbf ilogbl imaginary imaxabs imaxdiv index inet_addr inet_lnaof inet_makeaddr inet_netof inet_network
inet_ntoa inet_ntop inet_pton INFINITY initstate initstate_r insque isalnum isalpha isatty isblank iscanonical
iscntrl isdigit iseqsig isfinite isgraph isgreater isgreaterequal isinf isinff isinfl isless islessequal
islessgreater islower isnan isnanf isnanl isnormal isprint ispunct issignaling isspace issubnormal isunordered
isupper iswalnum iswalpha iswblank iswcntrl iswctype iswdigit iswgraph iswlower iswprint iswpunct iswspace
iswupper iswxdigit isxdigit iszero j0 j0f j0l j1 j1f j1l jn jnf jnl jrand48 jrand48_r kill kill_dependency
killpg l64a labs lchown lcong48 lcong48_r ldexp ldexpf ldexpl ldiv le16toh le32toh le64toh lfind lgamma
lgamma_r lgammaf lgammaf128_r lgammaf32_r lgammaf32x_r lgammaf64_r lgammaf64x_r lgammaf_r lgammal lgammal_r
link linkat linux lio_listio listen llabs lldiv llogb llogbf llogbl llrint llrintf llrintl llround llroundf
llroundl localeconv localtime localtime_r lockf log log10 log10f log10l log1p log1pf log1pl log2 log2f log2l
logb logbf logbl logf logl longjmp lrand48 lrand48_r lrint lrintf lrintl lround lroundf lroundl lsearch lseek
lstat main malloc MATH_ERREXCEPT math_errhandling MATH_ERRNO MAXFLOAT mblen mbrlen mbrtoc16 mbrtoc32 mbrtowc
mbsinit mbsrtowcs mbstowcs mbtowc memccpy memchr memcmp memcpy memfrob memmem memmove mempcpy memrchr memset
mkdir mkdirat mkdtemp mkfifo mkfifoat mknod mknodat mkostemp mkostemp64 mkostemps mkostemps64 mkstemp
mkstemp64 mkstemps mkstemps64 mktemp mktime mlock mlockall mmap modf modff modfl mprotect mq_close mq_getattr
mq_notify mq_open mq_receive mq_send mq_setattr mq_timedreceive mq_timedsend mq_unlink mrand48 mrand48_r
msgctl msgget msgrcv msgsnd msync mtx_destroy mtx_init mtx_lock mtx_timedlock mtx_trylock mtx_unlock munlock
munlockall munmap NAN nan nanf nanl nanosleep near nearbyint nearbyintf nearbyintl nextafter nextafterf
nextafterl nextdown nextdownf nextdownl nexttoward nexttowardf nexttowardl nextup nextupf nextupl NFDBITS nftw
nice nl_langinfo nl_langinfo_l noreturn nrand48 nrand48_r ntohl ntohs NULL obstack_printf obstack_vprintf
offsetof on_exit open open_memstream openat opendir openlog optarg opterr optind optopt pathconf pause pclose
perror pipe poll popen posix_fadvise posix_fallocate posix_madvise posix_memalign posix_openpt posix_spawn
posix_spawn_file_actions_addclose posix_spawn_file_actions_adddup2 posix_spawn_file_actions_addopen
posix_spawn_file_actions_destroy posix_spawn_file_actions_init posix_spawnattr_destroy
posix_spawnattr_getflags posix_spawnattr_getpgroup posix_spawnattr_getschedparam
posix_spawnattr_getschedpolicy posix_spawnattr_getsigdefault posix_spawnattr_getsigmask posix_spawnattr_init
posix_spawnattr_setflags posix_spawnattr_setpgroup posix_spawnattr_setschedparam
posix_spawnattr_setschedpolicy posix_spawnattr_setsigdefault posix_spawnattr_setsigmask posix_spawnp pow powf
powl pread printf program_invocation_name pselect psiginfo psignal pthread_atfork pthread_attr_destroy
pthread_attr_getdetachstate pthread_attr_getguardsize pthread_attr_getinheritsched pthread_attr_getschedparam
pthread_attr_getschedpolicy pthread_attr_getscope pthread_attr_getstack pthread_attr_getstackaddr
pthread_attr_getstacksize pthread_attr_init pthread_attr_setdetachstate pthread_attr_setguardsize
pthread_attr_setinheritsched pthread_attr_setschedparam pthread_attr_setschedpolicy pthread_attr_setscope
pthread_attr_setstack pthread_attr_setstackaddr pthread_attr_setstacksize pthread_barrier_destroy
pthread_barrier_init pthread_barrier_wait pthread_barrierattr_destroy pthread_barrierattr_getpshared
pthread_barrierattr_init pthread_barrierattr_setpshared pthread_cancel pthread_cond_broadcast
pthread_cond_destroy pthread_cond_init pthread_cond_signal pthread_cond_timedwait pthread_cond_wait
pthread_condattr_destroy pthread_condattr_getclock pthread_condattr_getpshared pthread_condattr_init
pthread_condattr_setclock pthread_condattr_setpshared pthread_create pthread_detach pthread_equal pthread_exit
pthread_getconcurrency pthread_getcpuclockid pthread_getschedparam pthread_getspecific pthread_join
pthread_key_create pthread_key_delete pthread_kill pthread_mutex_consistent pthread_mutex_destroy
pthread_mutex_getprioceiling pthread_mutex_init pthread_mutex_lock pthread_mutex_setprioceiling
pthread_mutex_timedlock pthread_mutex_trylock pthread_mutex_unlock pthread_mutexattr_destroy
pthread_mutexattr_getprioceiling pthread_mutexattr_getprotocol pthread_mutexattr_getpshared
pthread_mutexattr_getrobust pthread_mutexattr_gettype pthread_mutexattr_init pthread_mutexattr_setprioceiling
pthread_mutexattr_setprotocol pthread_mutexattr_setpshared pthread_mutexattr_setrobust
pthread_mutexattr_settype pthread_once pthread_rwlock_destroy pthread_rwlock_init pthread_rwlock_rdlock
pthread_rwlock_timedrdlock pthread_rwlock_timedwrlock pthread_rwlock_tryrdlock pthread_rwlock_trywrlock
pthread_rwlock_unlock pthread_rwlock_wrlock pthread_rwlockattr_destroy pthread_rwlockattr_getkind_np
pthread_rwlockattr_getpshared pthread_rwlockattr_init pthread_rwlockattr_setkind_np
pthread_rwlockattr_setpshared pthread_self pthread_setcancelstate pthread_setcanceltype pthread_setconcurrency
pthread_setschedparam pthread_setschedprio pthread_setspecific pthread_sigmask pthread_spin_destroy
pthread_spin_init pthread_spin_lock pthread_spin_trylock pthread_spin_unlock pthread_testcancel ptsname
ptsname_r putc putc_unlocked putchar putchar_unlocked putenv puts pututxline putw putwc putwchar pwrite qecvt
qecvt_r qfcvt qfcvt_r qgcvt qsort qsort_r quick_exit raise rand RAND_MAX rand_r random random_r rawmemchr read
readdir readdir_r readlink readlinkat readv realloc reallocarray realpath recv recvfrom recvmsg regcomp
regerror regexec regfree remainder remainderf remainderl remove remque remquo remquof remquol rename renameat
renameat2 rewind rewinddir rindex rint rintf rintl rmdir round roundeven roundevenf roundevenl roundf roundl
rpmatch scalb scalbf scalbl scalbln scalblnf scalblnl scalbn scalbnf scalbnl scandir scanf
sched_get_priority_max sched_get_priority_min sched_getparam sched_getscheduler sched_rr_get_interval
sched_setparam sched_setscheduler sched_yield secure_getenv seed48 seed48_r seekdir select sem_close
sem_destroy sem_getvalue sem_init sem_open sem_post sem_timedwait sem_trywait sem_unlink sem_wait semctl
semget semop send sendmsg sendto setbuf setbuffer setegid setenv seteuid setgid setgrent sethostent setitimer
setjmp setlinebuf setlocale setlogmask setnetent setpayload setpayloadf setpayloadl setpayloadsig
setpayloadsigf setpayloadsigl setpgid setpgrp setpriority setprotoent setpwent setregid setreuid setrlimit
setservent setsid setsockopt setstate setstate_r setuid setutxent setvbuf shm_open shm_unlink shmat shmctl
shmdt shmget shutdown sigabbrev_np sigaction sigaddset sigaltstack sigdelset sigdescr_np sigemptyset
sigfillset sighold sigignore siginterrupt sigismember signal signbit signgam significand significandf
significandl sigpause sigpending sigprocmask sigqueue sigrelse sigset sigsuspend sigtimedwait sigwait
sigwaitinfo sin sincos sincosf sincosl sinf sinh sinhf sinhl sinl sleep SNAN SNANF SNANF128 SNANF32 SNANF32X
SNANF64 SNANF64X SNANL snprintf sockatmark socket socketpair sprintf sqrt sqrtf sqrtl srand srand48 srand48_r
srandom srandom_r sscanf stat statvfs stderr stdin stdout stpcpy stpncpy strcasecmp strcasecmp_l strcasestr
strcat strchr strchrnul strcmp strcoll strcoll_l strcpy strcspn strdup strdupa strerror strerror_l strerror_r
strerrordesc_np strerrorname_np strfmon strfmon_l strfromd strfromf strfroml strfry strftime strftime_l strlen
strncasecmp strncasecmp_l strncat strncmp strncpy strndup strndupa strnlen strpbrk strptime strrchr strsep
strsignal strspn strstr strtod strtod_l strtof strtof128_l strtof32_l strtof32x_l strtof64_l strtof64x_l
strtof_l strtoimax strtok strtok_r strtol strtol_l strtold strtold_l strtoll strtoll_l strtoq strtoul
strtoul_l strtoull strtoull_l strtoumax strtouq strverscmp strxfrm strxfrm_l swab swprintf swscanf symlink
symlinkat sync sysconf syslog system tan tanf tanh tanhf tanhl tanl tcdrain tcflow tcflush tcgetattr tcgetpgrp
tcgetsid tcsendbreak tcsetattr tcsetpgrp tdelete telldir tempnam tfind tgamma tgammaf tgammal thrd_create
thrd_current thrd_detach thrd_equal thrd_exit thrd_join thrd_sleep thrd_yield time timer_create timer_delete
timer_getoverrun timer_gettime timer_settime times timespec_get timezone tmpfile tmpfile64 tmpnam tmpnam_r
tolower totalorder totalorderf totalorderl totalordermag totalordermagf totalordermagl toupper towctrans
towlower towupper trunc truncate truncf truncl tsearch tss_create tss_delete tss_get tss_set ttyname ttyname_r
twalk tzname tzset ufromfp ufromfpf ufromfpl ufromfpx ufromfpxf ufromfpxl ulimit umask uname ungetc ungetwc
unix unlink unlinkat unlockpt unsetenv utime utimensat utimes va_arg va_copy va_end va_start valloc vasprintf
vdprintf vfprintf vfscanf vfwprintf vfwscanf vprintf vscanf vsnprintf vsprintf vsscanf vswprintf vswscanf
vwprintf vwscanf wait waitid waitpid wcrtomb wcscat wcschr wcscmp wcscoll wcscpy wcscspn wcsftime wcslen
wcsncat wcsncmp wcsncpy wcspbrk wcsrchr wcsrtombs wcsspn wcsstr wcstod wcstof wcstoimax wcstok wcstol wcstold
wcstoll wcstombs wcstoul wcstoull wcstoumax wcsxfrm wctob wctomb wctrans wctype WinMain wmemchr wmemcmp
wmemcpy wmemmove wmemset wordexp wordfree wprintf write writev wscanf y0 y0f y0l y1 y1f y1l yn ynf ynl
arm i386 mips sparc vax
"""
KEYWORDS, LIBRARY = frozenset(_KEYWORDS.split()), frozenset(_LIBRARY.split())


def refused_name(name: str, own: frozenset[str] = frozenset()) -> str:
    """Why a C function cannot have a name; empty if it can. ``own`` are names that the code beside it takes.

    Example:
        >>> refused_name("torque"), refused_name("double"), refused_name("sin")
        ('', 'is a keyword of C or C++', 'is a name of the C library')
    """
    if not _IDENTIFIER.fullmatch(name) or len(name) > MOST:
        return f"is no name in C: a letter, then letters, digits and _, at most {MOST} in all"
    if name in KEYWORDS:
        return "is a keyword of C or C++"
    if name in LIBRARY or name in own:
        return "is a name of the C library" if name in LIBRARY else "is a name of the generated test program"
    return "is reserved in C" if _RESERVED.fullmatch(name) else ""
