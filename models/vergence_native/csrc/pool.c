/* A few threads that share the chunks of one loop. They sleep between loops. */
#include <stdlib.h>
#include "lite.h"

#ifdef _WIN32
#include <windows.h>
typedef CRITICAL_SECTION Mutex;
typedef CONDITION_VARIABLE Condition;
typedef HANDLE Thread;
static void mutex_new(Mutex *m) { InitializeCriticalSection(m); }
static void mutex_free(Mutex *m) { DeleteCriticalSection(m); }
static void lock(Mutex *m) { EnterCriticalSection(m); }
static void unlock(Mutex *m) { LeaveCriticalSection(m); }
static void condition_new(Condition *c) { InitializeConditionVariable(c); }
static void condition_free(Condition *c) { (void)c; }
static void wait_for(Condition *c, Mutex *m) { SleepConditionVariableCS(c, m, INFINITE); }
static void wake_all(Condition *c) { WakeAllConditionVariable(c); }
static void wake_one(Condition *c) { WakeConditionVariable(c); }
#else
#include <pthread.h>
typedef pthread_mutex_t Mutex;
typedef pthread_cond_t Condition;
typedef pthread_t Thread;
static void mutex_new(Mutex *m) { pthread_mutex_init(m, NULL); }
static void mutex_free(Mutex *m) { pthread_mutex_destroy(m); }
static void lock(Mutex *m) { pthread_mutex_lock(m); }
static void unlock(Mutex *m) { pthread_mutex_unlock(m); }
static void condition_new(Condition *c) { pthread_cond_init(c, NULL); }
static void condition_free(Condition *c) { pthread_cond_destroy(c); }
static void wait_for(Condition *c, Mutex *m) { pthread_cond_wait(c, m); }
static void wake_all(Condition *c) { pthread_cond_broadcast(c); }
static void wake_one(Condition *c) { pthread_cond_signal(c); }
#endif

struct Pool {
    Mutex mutex;
    Condition work, done;
    int threads;    /* the caller's thread is one of them */
    int is_taken, is_closing;
    unsigned round; /* counts the loops */
    int running;    /* helpers inside the loop */
    Task *task;
    void *context;
    int chunks, next;
    struct Helper {
        Pool *pool;
        Thread thread;
        int worker;
    } helper[MAX_THREADS];
};

/* Take chunks until none is left; the mutex is held on entry and on return. */
static void take_chunks(Pool *pool, int worker) {
    while (pool->next < pool->chunks) {
        int chunk = pool->next++;
        unlock(&pool->mutex);
        pool->task(pool->context, chunk, worker);
        lock(&pool->mutex);
    }
}

static void help(struct Helper *self) {
    Pool *pool = self->pool;
    unsigned seen = 0;
    lock(&pool->mutex);
    for (;;) {
        while (!pool->is_closing && (pool->round == seen || pool->next >= pool->chunks)) {
            seen = pool->round;
            wait_for(&pool->work, &pool->mutex);
        }
        if (pool->is_closing)
            break;
        seen = pool->round;
        pool->running++;
        take_chunks(pool, self->worker);
        if (--pool->running == 0)
            wake_one(&pool->done);
    }
    unlock(&pool->mutex);
}

#ifdef _WIN32
static DWORD WINAPI entry(LPVOID self) { help(self); return 0; }
static int start(struct Helper *h) {
    h->thread = CreateThread(NULL, 0, entry, h, 0, NULL);
    return h->thread != NULL;
}
static void join(struct Helper *h) { WaitForSingleObject(h->thread, INFINITE); CloseHandle(h->thread); }
#else
static void *entry(void *self) { help(self); return NULL; }
static int start(struct Helper *h) { return pthread_create(&h->thread, NULL, entry, h) == 0; }
static void join(struct Helper *h) { pthread_join(h->thread, NULL); }
#endif

Pool *pool_new(int threads) {
    Pool *pool = calloc(1, sizeof(Pool));
    if (!pool)
        return NULL;
    mutex_new(&pool->mutex);
    condition_new(&pool->work);
    condition_new(&pool->done);
    pool->threads = 1;
    while (pool->threads < threads && pool->threads < MAX_THREADS) {
        struct Helper *helper = &pool->helper[pool->threads];
        helper->pool = pool;
        helper->worker = pool->threads;
        if (!start(helper))
            break; /* fewer threads give the same answers */
        pool->threads++;
    }
    return pool;
}

void pool_free(Pool *pool) {
    if (!pool)
        return;
    lock(&pool->mutex);
    pool->is_closing = 1;
    wake_all(&pool->work);
    unlock(&pool->mutex);
    for (int i = 1; i < pool->threads; i++)
        join(&pool->helper[i]);
    condition_free(&pool->work);
    condition_free(&pool->done);
    mutex_free(&pool->mutex);
    free(pool);
}

int pool_threads(const Pool *pool) { return pool->threads; }

int pool_take(Pool *pool) {
    lock(&pool->mutex);
    int free_now = !pool->is_taken && !pool->is_closing;
    if (free_now)
        pool->is_taken = 1;
    unlock(&pool->mutex);
    return free_now;
}

void pool_give(Pool *pool) {
    lock(&pool->mutex);
    pool->is_taken = 0;
    unlock(&pool->mutex);
}

void pool_run(Pool *pool, Task *task, void *context, int chunks) {
    if (!pool || pool->threads == 1 || chunks < 2) {
        for (int chunk = 0; chunk < chunks; chunk++)
            task(context, chunk, 0);
        return;
    }
    lock(&pool->mutex);
    pool->task = task;
    pool->context = context;
    pool->chunks = chunks;
    pool->next = 0;
    pool->round++;
    wake_all(&pool->work);
    take_chunks(pool, 0);
    while (pool->running)
        wait_for(&pool->done, &pool->mutex);
    unlock(&pool->mutex);
}
