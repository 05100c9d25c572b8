// What is wrong, where the page would say "Loading" for ever: a script that failed, a file that was
// cut off, a browser that cannot. In the language of old browsers.
window.splatFailed = function (reason) {
    var message = document.getElementById("message");
    if (window.splatStarted) return;
    message.setAttribute("role", "alert");
    message.textContent = "The splats cannot be shown: " + reason;
    message.hidden = false;
    document.body.className += " failed";
};
window.addEventListener("error", function (event) {
    window.splatFailed(event.message + ". A newer browser may show them.");
});
window.addEventListener("unhandledrejection", function (event) {
    window.splatFailed((event.reason && event.reason.message) || String(event.reason));
});
window.addEventListener("load", function () {
    if (!window.splatReady) window.splatFailed("this file is not complete. Get it again.");
});
