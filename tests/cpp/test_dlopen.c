/* The library is loaded, used and unloaded again and again, also by several threads, as plug-in hosts do. */
#include <dlfcn.h>
#include <pthread.h>
#include <stdio.h>
#include <string.h>

#include <meshwright.h>

static const char *path;

static int use(void)
{
    void *library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    mw_status (*context_create)(int32_t, mw_context **);
    void (*context_destroy)(mw_context *);
    const char *(*last_error)(void);
    mw_context *context = NULL;

    if (!library) {
        fprintf(stderr, "%s\n", dlerror());
        return 1;
    }
    *(void **)(&context_create) = dlsym(library, "mw_context_create");
    *(void **)(&context_destroy) = dlsym(library, "mw_context_destroy");
    *(void **)(&last_error) = dlsym(library, "mw_last_error");
    if (!context_create || !context_destroy || !last_error) return 1;
    if (context_create(-1, &context) != MW_E_ARG || strlen(last_error()) == 0) return 1;
    if (context_create(3, &context) != MW_OK) return 1;
    context_destroy(context);
    return dlclose(library) != 0;
}

static void *worker(void *argument)
{
    int round;
    int *failed = (int *)argument;
    for (round = 0; round < 20; round++) *failed |= use();
    return NULL;
}

int main(int argc, char **argv)
{
    int round, failed = 0, in_thread[4] = {0, 0, 0, 0};
    pthread_t threads[4];

    if (argc != 2) return 2;
    path = argv[1];
    for (round = 0; round < 20; round++) failed |= use();
    /* Threads that end after the library was closed run its thread-local destructors. */
    for (round = 0; round < 4; round++) failed |= pthread_create(&threads[round], NULL, worker, &in_thread[round]);
    for (round = 0; round < 4; round++) {
        pthread_join(threads[round], NULL);
        failed |= in_thread[round];
    }
    return failed;
}
